"""Print the scores that trackeval gives to the tracks of a file; runs in an environment of its own."""

import json
import sys
from pathlib import Path

import numpy as np
from trackeval.metrics import CLEAR, Identity


def overlap(a, b):
    """Intersection over union of boxes (left, top, width, height)."""
    (a, b), area = (np.array(each, dtype=float).reshape(-1, 4) for each in (a, b)), lambda box: box[..., 2:].prod(-1)
    low = np.maximum(a[:, None, :2], b[:, :2])
    high = np.minimum((a[:, :2] + a[:, 2:])[:, None], b[:, :2] + b[:, 2:])
    shared = np.maximum(high - low, 0).prod(-1)
    return shared / (area(a)[:, None] + area(b) - shared)


frames = json.loads(Path(sys.argv[1]).read_text())  # for each frame: targets and tracks, each [[id, box], ...]
known = [sorted({each[0] for frame in frames for each in frame[k]}) for k in (0, 1)]
ids = [[np.array([known[k].index(each[0]) for each in frame[k]], dtype=int) for frame in frames] for k in (0, 1)]
data = {
    "num_timesteps": len(frames),
    "num_gt_ids": len(known[0]),
    "num_tracker_ids": len(known[1]),
    "num_gt_dets": sum(map(len, ids[0])),
    "num_tracker_dets": sum(map(len, ids[1])),
    "gt_ids": ids[0],
    "tracker_ids": ids[1],
    "similarity_scores": [overlap(*([each[1] for each in frame[k]] for k in (0, 1))) for frame in frames],
}
clear, identity = (each({"PRINT_CONFIG": False}).eval_sequence(data) for each in (CLEAR, Identity))
names = {"CLR_TP": "found", "CLR_FP": "false_boxes", "IDSW": "id_switches", "MOTA": "mota"}
print(json.dumps({name: float(clear[key]) for key, name in names.items()} | {"idf1": float(identity["IDF1"])}))
