"""Networks built by hand, whose boxes are known: each finds what is red, green and blue, as classes 0, 1 and 2."""

import builtins
import contextlib
import dataclasses

import cv2
import numpy as np
import pytest

from cotarget.config import DEFAULT_TARGETS, NetworkConfig, parse_config
from cotarget.detection import make_detector
from cotarget.detection.network import Network
from cotarget.doctor import examine
from cotarget.errors import ConfigError
from cotarget.rig import Frame

onnx = pytest.importorskip("onnx")

SIDE = 96, 64  # width and height of the networks' input
SCORES = 0.9, 0.8, 0.7  # of the classes
LAYOUTS = ["yolo", "yolov5", "yolov10", "ssd", "ssd rows", "detr", "rtdetr"]


class Graph:
    """An ONNX graph that is written line by line."""

    def __init__(self, side=SIDE, channels=3):
        self.nodes, self.constants = [], []
        self.input = [1, channels, side[1], side[0]]

    def const(self, value, dtype=np.float32):
        name = f"constant{len(self.constants)}"
        self.constants.append(onnx.numpy_helper.from_array(np.array(value, dtype), name))
        return name

    def __call__(self, op, *inputs, name=None, **attributes):
        name = name or f"{op}{len(self.nodes)}"
        inputs = [each if isinstance(each, str) else self.const(each) for each in inputs]
        self.nodes.append(onnx.helper.make_node(op, inputs, [name], **attributes))
        return name

    def save(self, path, **outputs):
        """Write the file; the outputs by their shapes."""
        infos = [onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, self.input)] + [
            onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape) for name, shape in outputs.items()
        ]
        graph = onnx.helper.make_graph(self.nodes, "graph", infos[:1], infos[1:], self.constants)
        opset = [onnx.helper.make_opsetid("", 13)]
        onnx.save(onnx.helper.make_model(graph, opset_imports=opset, ir_version=8), path)
        return path


def edges(g, side):
    """Corners of what is above half of full brightness in each channel, as (1, 3, 1) each, and scores, (1, 3, 1)."""
    found = []
    for axis, n in ((2, side[0]), (3, side[1])):  # what remains after the other axis is reduced
        line = g("ReduceMax", "x", axes=[axis], keepdims=0)
        lit = g("Clip", g("Mul", g("Sub", line, 0.5), 1000.0), 0.0, 1.0)
        last = g("ReduceMax", g("Mul", lit, [[np.arange(1, n + 1)]]), axes=[2], keepdims=1)
        first = g("Sub", float(n), g("ReduceMax", g("Mul", lit, [[np.arange(n, 0, -1)]]), axes=[2], keepdims=1))
        found.append((first, last, g("ReduceMax", lit, axes=[2], keepdims=1)))
    (left, right, seen), (top, bottom, _) = found
    return left, top, right, bottom, g("Mul", seen, np.reshape(SCORES, (1, 3, 1)))


def network(path, layout, side=SIDE, names=("boxes", "labels", "scores"), off=0.0):
    """Write a network of a layout, whose boxes are too large by a part of their size, if it is off."""
    g = Graph(side)
    left, top, right, bottom, score = edges(g, side)
    if off:
        width, height = (g("Mul", g("Sub", b, a), off / 2) for a, b in ((left, right), (top, bottom)))
        left, right = g("Sub", left, width), g("Add", right, width)
        top, bottom = g("Sub", top, height), g("Add", bottom, height)
    centers = [g("Mul", g("Add", a, b), 0.5) for a, b in ((left, right), (top, bottom))]
    sizes = [g("Sub", b, a) for a, b in ((left, right), (top, bottom))]
    classes = g("Mul", score, [np.eye(3)])
    if layout in ("yolo", "yolov5"):
        objectness = [score] if layout == "yolov5" else []
        each = np.eye(3)[None] if objectness else classes
        rows = g("Concat", *centers, *sizes, *objectness, each, axis=2)
        columns = (1, 1, 7 + len(objectness))
        further, worse = np.zeros(columns), np.ones(columns)
        further[..., :2], worse[..., 4] = 0.5, 0.9
        worse[..., 4:] = worse[..., 4:5]
        again = g("Mul", g("Add", rows, further), worse)  # every target is found twice, half a pixel further
        twice = g("Concat", again, rows, axis=1, name=None if layout == "yolo" else "output")
        if layout == "yolo":
            g("Transpose", twice, perm=[0, 2, 1], name="output")
            return g.save(path, output=[1, 7, 6])
        return g.save(path, output=[1, 6, 8])
    numbers = np.arange(3.0).reshape(1, 3, 1)
    if layout == "yolov10":
        g("Concat", left, top, right, bottom, score, numbers, axis=2, name="output")
        return g.save(path, output=[1, 3, 6])
    whole = np.array([*side, *side], dtype=float).reshape(1, 1, 4)
    if layout == "ssd":
        g("Div", g("Concat", left, top, right, bottom, axis=2), whole, name=names[0])
        g("Reshape", g("Add", numbers, g("Mul", score, 0.0)), g.const([1, 3], np.int64), name=names[1])
        g("Reshape", score, g.const([1, 3], np.int64), name=names[2])
        return g.save(path, **dict(zip(names, ([1, 3, 4], [1, 3], [1, 3]), strict=True)))
    if layout == "ssd rows":
        parts = g("Div", g("Concat", left, top, right, bottom, axis=2), whole)
        rows = g("Concat", np.zeros((1, 3, 1)), numbers, score, parts, axis=2)
        g("Reshape", rows, g.const([1, 1, 3, 7], np.int64), name="output")
        return g.save(path, output=[1, 1, 3, 7])
    g("Div", g("Concat", *centers, *sizes, axis=2), whole, name="pred_boxes")
    held = g("Clip", classes, 1e-6, 1.0)  # logits of these scores
    logits = g("Sub", g("Log", held), g("Log", g("Sub", 1.0, held)), name="logits" if layout == "rtdetr" else None)
    if layout == "detr":
        g("Concat", logits, np.zeros((1, 3, 1)), axis=2, name="logits")
    return g.save(path, logits=[1, 3, 3 + (layout == "detr")], pred_boxes=[1, 3, 4])


def detector(path, layout="yolo", **settings):
    config = NetworkConfig(path, layout.split()[0], **settings)
    return make_detector(dataclasses.replace(DEFAULT_TARGETS["bird"], detector="onnx", network=config), 25.0)


def image(width, height, **squares):
    """Grey, with rectangles (left, top, width, height) [px]."""
    picture = np.full((height, width, 3), 60, np.uint8)
    for colour, (x, y, w, h) in squares.items():
        picture[y : y + h, x : x + w, ("blue", "green", "red").index(colour)] = 255
    return picture


def boxes(found):
    """(left, top, width, height) of detections [px]."""
    return [[*(each.center_px - (each.size_px - 1) / 2), *each.size_px] for each in found]


def edges_of(box):
    x, y, width, height = box
    return [x, y, x + width, y + height]


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize(("width", "height"), [(96, 64), (48, 24), (192, 128), (200, 100), (100, 200)])
def test_boxes_of_every_layout_are_where_the_targets_are(tmp_path, layout, width, height):
    """To a pixel of the input, whatever the image's size and proportions; exactly where it is scaled by 1 or 1/2."""
    parts = {"red": (0.1, 0.1, 0.4, 0.2), "green": (0.5, 0.5, 0.3, 0.3), "blue": (0.0, 0.7, 0.2, 0.25)}
    targets = {
        name: 4 * np.rint(np.multiply(part, (width, height) * 2) / 4).astype(int) for name, part in parts.items()
    }
    found = (
        detector(network(tmp_path / "n.onnx", layout), layout).detect(Frame(image(width, height, **targets), 0.0)).boxes
    )
    assert [each.score for each in found] == pytest.approx(SCORES, abs=1e-3)
    pixel = max(width / SIDE[0], height / SIDE[1])
    for found_at, target in zip(map(edges_of, boxes(found)), map(edges_of, targets.values()), strict=True):
        np.testing.assert_allclose(found_at, target, atol=0.001 if pixel in (1, 2) else max(1, pixel))
    assert [each.clipped for each in found] == [False, False, True]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_only_the_wanted_classes_are_found(tmp_path, layout):
    picture = image(96, 64, red=(8, 4, 20, 8), green=(30, 30, 16, 6), blue=(60, 10, 8, 8))
    path = network(tmp_path / "n.onnx", layout)
    assert boxes(detector(path, layout, classes=(2,)).detect(Frame(picture, 0.0)).boxes) == [
        pytest.approx([60, 10, 8, 8])
    ]
    found = detector(path, layout, classes=(2, 0), least_score=0.75).detect(Frame(picture, 0.0)).boxes
    assert boxes(found) == [pytest.approx([8, 4, 20, 8])]


def test_images_are_searched_in_tiles_without_doubles_at_their_seams(tmp_path):
    """A target of 12 px fades in the whole image, which is a third as large; one of 300 px is in no tile."""
    find = detector(network(tmp_path / "n.onnx", "yolo", (192, 128)), tiled=True)
    for y in range(0, 390, 61):
        for x in range(0, 588, 23):
            found = find.detect(Frame(image(600, 400, red=(x, y, 12, 10)), 0.0)).boxes
            assert boxes(found) == [pytest.approx([x, y, 12, 10])]
    found = find.detect(Frame(image(600, 400, red=(120, 100, 300, 180)), 0.0)).boxes
    assert len(found) == 1
    np.testing.assert_allclose(boxes(found), [[120, 100, 300, 180]], atol=3.2)
    assert find.detect(Frame(image(600, 400), 0.0)).boxes == []


@pytest.mark.parametrize("off", [-0.1, -0.05, 0.05, 0.1])
def test_boxes_that_are_not_exact_are_one_at_seams_too(tmp_path, off):
    """Targets of a fiftieth of the image to half of it, at many places."""
    find = detector(network(tmp_path / "n.onnx", "yolo", (192, 128), off=off), tiled=True)
    rng = np.random.default_rng(2)
    for width in (12, 20, 30, 45, 60, 100, 150, 300):
        height = max(8, width * 2 // 3)
        for _ in range(6):
            x, y = rng.integers(0, (600 - width, 400 - height))
            found = boxes(find.detect(Frame(image(600, 400, red=(x, y, width, height)), 0.0)).boxes)
            assert len(found) == 1, (width, x, y)
            np.testing.assert_allclose(edges_of(found[0]), edges_of((x, y, width, height)), atol=3.5 + 0.06 * width)


def test_levels_are_scaled_as_the_table_says(tmp_path):
    path = network(tmp_path / "n.onnx", "yolo")
    dim = (image(96, 64, red=(8, 4, 20, 8)) // 3).astype(np.uint8)
    assert detector(path).detect(Frame(dim, 0.0)).boxes == []
    assert len(detector(path, std=(100.0, 255.0, 255.0)).detect(Frame(dim, 0.0)).boxes) == 1
    assert len(detector(path, mean=(20.0, 0.0, 0.0), std=(100.0, 255.0, 255.0)).detect(Frame(dim, 0.0)).boxes) == 1
    assert detector(path, mean=(0.0, 0.0, 20.0), std=(255.0, 255.0, 100.0)).detect(Frame(dim, 0.0)).boxes == []


def test_a_file_that_leaves_its_size_open_takes_that_of_the_table(tmp_path):
    path = network(tmp_path / "n.onnx", "yolo")
    model = onnx.load(path)
    for dim, name in zip(model.graph.input[0].type.tensor_type.shape.dim[2:], ("height", "width"), strict=True):
        dim.dim_param = name
    onnx.save(model, path)
    with pytest.raises(ConfigError, match=r"leaves the size of its input open; write network.input_px = \[640, 640\]"):
        detector(path)
    assert len(detector(path, input_px=SIDE).detect(Frame(image(96, 64, red=(8, 4, 20, 8)), 0.0)).boxes) == 1


def test_a_file_that_opencv_cannot_run_is_run_by_onnxruntime(tmp_path, monkeypatch):
    pytest.importorskip("onnxruntime")
    path = network(tmp_path / "n.onnx", "yolo")
    model = onnx.load(path)
    del model.graph.output[:]
    model.graph.node[-1].output[0] = "before"
    noise = onnx.helper.make_node("RandomUniformLike", ["before"], ["noise"], low=0.0, high=1e-6)
    model.graph.node.extend([noise, onnx.helper.make_node("Add", ["before", "noise"], ["output"])])
    model.graph.output.append(onnx.helper.make_tensor_value_info("output", onnx.TensorProto.FLOAT, [1, 7, 6]))
    onnx.save(model, path)
    with pytest.raises(cv2.error):
        cv2.dnn.readNetFromONNX(str(path))
    found = detector(path).detect(Frame(image(96, 64, green=(30, 10, 16, 6)), 0.0)).boxes
    assert boxes(found) == [pytest.approx([30, 10, 16, 6])]

    real = builtins.__import__

    def without(name, *rest):
        if name == "onnxruntime":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(
        ConfigError, match=r"OpenCV cannot run it \(.+\); onnxruntime, .+ -m pip install 'onnxruntime>=[\d.]+'$"
    ):
        detector(path)


@pytest.mark.parametrize("raw", [{}, {"raw": [1, 1, 3, 6]}])
def test_a_network_that_finds_nothing_gives_no_rows(tmp_path, raw):
    """As with suppression inside the file: the number of boxes is that of the targets."""
    g = Graph()
    left, top, right, bottom, score = edges(g, SIDE)
    table = g("Concat", left, top, right, bottom, score, np.arange(3.0).reshape(1, 3, 1), axis=2)
    seen = g("Greater", g("Reshape", score, g.const([3], np.int64)), 0.5)
    rows = g("Reshape", g("NonZero", seen), g.const([-1], np.int64))
    g("Gather", table, rows, axis=1, name="output")
    if raw:
        g("Reshape", table, g.const(raw["raw"], np.int64), name="raw")
    find = detector(g.save(tmp_path / "n.onnx", **raw, output=[1, "found", 6]), "yolov10")
    assert find.detect(Frame(image(96, 64), 0.0)).boxes == []
    assert boxes(find.detect(Frame(image(96, 64, red=(8, 4, 20, 8)), 0.0)).boxes) == [pytest.approx([8, 4, 20, 8])]
    assert find.detect(Frame(image(96, 64), 0.0)).boxes == []


def beside(path, runtime, first, **heads):
    """Give a network further outputs of these shapes, which hold its own numbers; OpenCV cannot run some."""
    model = onnx.load(path)
    op = {"OpenCV": "Identity", "onnxruntime": "RandomUniformLike"}[runtime]
    model.graph.node.append(onnx.helper.make_node(op, ["output"], ["copy"]))
    for name, (shape, declared) in heads.items():
        model.graph.initializer.append(onnx.numpy_helper.from_array(np.array(shape), f"shape of {name}"))
        model.graph.node.append(onnx.helper.make_node("Reshape", ["copy", f"shape of {name}"], [name]))
        info = onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, declared)
        model.graph.output.insert(0, info) if first else model.graph.output.append(info)
    onnx.save(model, path)
    return path


@pytest.mark.parametrize("runtime", ["OpenCV", "onnxruntime"])
@pytest.mark.parametrize("first", [False, True])
@pytest.mark.parametrize(("layout", "shapes"), [
    ("yolo", [[1, 7, 3, 2], [1, 7, 6, 1], [1, 1, 7, 6]]), ("yolov5", [[1, 3, 2, 1, 8], [2, 3, 8], [6, 8]]),
    ("yolov10", [[1, 3, 6, 1], [1, 2, 9]]), ("ssd rows", [[1, 3, 7, 1], [21]]),
])  # fmt: skip
def test_the_output_of_the_layout_is_read_beside_raw_heads(tmp_path, layout, shapes, first, runtime):
    if runtime == "onnxruntime":
        pytest.importorskip(runtime)
    heads = {f"{540 + i}": (shape, [None if i else n for n in shape]) for i, shape in enumerate(shapes)}
    path = beside(network(tmp_path / "n.onnx", layout), runtime, first, **heads)
    assert str(Network(NetworkConfig(path, layout.split()[0]))).endswith(f"run by {runtime}")
    find = detector(path, layout)
    for x in (8, 40):
        assert boxes(find.detect(Frame(image(96, 64, red=(x, 4, 20, 8)), 0.0)).boxes) == [pytest.approx([x, 4, 20, 8])]
    assert find.detect(Frame(image(96, 64), 0.0)).boxes == []


def test_an_output_that_is_not_known_to_be_the_one_is_refused_with_the_way_out(tmp_path):
    two = beside(network(tmp_path / "two.onnx", "yolo"), "OpenCV", False, copied=([1, 7, 6], [1, 7, 6]))
    raw = beside(network(tmp_path / "raw.onnx", "ssd rows"), "OpenCV", False, raw=([1, 3, 7, 1], [1, 3, 7, 1]))
    for path, layout, message in (
        (two, "yolo", r"gives output \(1, 7, 6\), copied \(1, 7, 6\); .*; output and copied fit it: keep one by "),
        (raw, "yolov5", r"gives output \(1, 1, 3, 7\), raw \(1, 3, 7, 1\); .* as by export.py, of YOLOv7 with --grid"),
    ):
        with pytest.raises(ConfigError, match=message):
            detector(path, layout)


def test_one_table_of_boxes_and_scores_is_an_rtdetr_too(tmp_path):
    g = Graph()
    left, top, right, bottom, score = edges(g, SIDE)
    centers = [g("Mul", g("Add", a, b), 0.5 / n) for a, b, n in ((left, right, SIDE[0]), (top, bottom, SIDE[1]))]
    sizes = [g("Mul", g("Sub", b, a), 1 / n) for a, b, n in ((left, right, SIDE[0]), (top, bottom, SIDE[1]))]
    g("Concat", *centers, *sizes, g("Mul", score, [np.eye(3)]), axis=2, name="output")
    find = detector(g.save(tmp_path / "n.onnx", output=[1, 3, 7]), "rtdetr")
    assert boxes(find.detect(Frame(image(96, 64, blue=(8, 4, 20, 8)), 0.0)).boxes) == [
        pytest.approx([8, 4, 20, 8], abs=0.01)
    ]


def test_another_layout_gives_no_wrong_boxes(tmp_path):
    """Each file as each other layout: an error, or nothing is found; never a wrong box."""
    target = (8, 4, 20, 8)
    for written in LAYOUTS:
        path = network(tmp_path / f"{written}.onnx", written)
        for read in {each.split()[0] for each in LAYOUTS} - {written.split()[0], "detr", "rtdetr"}:
            with contextlib.suppress(ConfigError):
                found = detector(path, read).detect(Frame(image(96, 64, red=target), 0.0)).boxes
                assert found == [], (written, read)


@pytest.mark.parametrize(("layout", "columns"), [("yolo", 4), ("yolov5", 5), ("rtdetr", 4)])
def test_a_network_without_a_class_is_refused_in_one_line(tmp_path, layout, columns):
    g = Graph()
    one = g("ReduceMax", "x", axes=[1, 2, 3], keepdims=1)
    table = g("Reshape", g("Mul", one, np.full((1, 1, 3, columns), 0.5)), g.const([1, 3, columns], np.int64))
    perm = [0, 2, 1] if layout == "yolo" else [0, 1, 2]
    g("Transpose", table, perm=perm, name="output")
    path = g.save(tmp_path / "n.onnx", output=[1, columns, 3] if layout == "yolo" else [1, 3, columns])
    with pytest.raises(ConfigError, match=rf'n\.onnx: gives output \([\d, ]+\); layout "{layout}" has [^\n]+$'):
        detector(path, layout).detect(Frame(image(96, 64, red=(8, 4, 20, 8)), 0.0))


def test_files_that_take_something_else_are_refused(tmp_path):
    """Each is refused before it is run, because OpenCV runs some of them with wrong results."""
    onnx_file = network(tmp_path / "n.onnx", "yolo")

    def altered(change):
        model = onnx.load(onnx_file)
        change(model.graph)
        onnx.save(model, tmp_path / "altered.onnx")
        with pytest.raises(ConfigError) as caught:
            detector(tmp_path / "altered.onnx")
        assert "\n" not in str(caught.value)
        return str(caught.value)

    def shape(*lengths):
        def change(graph):
            graph.input[0].type.tensor_type.shape.ClearField("dim")
            for length in lengths:
                graph.input[0].type.tensor_type.shape.dim.add(dim_value=length)

        return change

    def add_input(graph):
        graph.input.append(onnx.helper.make_tensor_value_info("orig_target_sizes", onnx.TensorProto.INT64, [1, 2]))

    def bytes_input(graph):
        graph.input[0].type.tensor_type.elem_type = onnx.TensorProto.UINT8

    assert altered(shape(1, 64, 96, 3)).endswith("takes 1 x 64 x 96 x 3; export it for 1 x 3 x height x width, float32")
    assert "takes 1 x 1 x 64 x 96;" in altered(shape(1, 1, 64, 96))
    assert "takes 3 x 64 x 96;" in altered(shape(3, 64, 96))
    assert altered(shape(1, 3, 64, -1)).endswith("write network.input_px = [640, 64], for example")
    assert "which is not float32" in altered(bytes_input)
    assert altered(add_input).endswith("has inputs x, orig_target_sizes; export it with the image as its only one")

    weights = onnx.load(onnx_file)  # old files list their weights among the inputs, some of them first
    for tensor in weights.graph.initializer:
        weights.graph.input.insert(0, onnx.helper.make_tensor_value_info(tensor.name, tensor.data_type, tensor.dims))
    onnx.save(weights, tmp_path / "weights.onnx")
    found = detector(tmp_path / "weights.onnx").detect(Frame(image(96, 64, green=(30, 10, 16, 6)), 0.0)).boxes
    assert boxes(found) == [pytest.approx([30, 10, 16, 6])]


def test_damaged_files_are_refused(tmp_path):
    whole, damaged = network(tmp_path / "n.onnx", "yolo").read_bytes(), tmp_path / "damaged.onnx"
    name = whole.index(b"Transpose")
    for data in (whole[:200], whole[:-100], b"", b"\xff" * 10**6, whole[:name] + b"\xff" + whole[name + 1 :]):
        damaged.write_bytes(data)
        with pytest.raises(ConfigError, match=r"damaged.onnx: is no ONNX file$"):
            detector(damaged)


def test_what_is_wrong_with_a_network_is_said_in_one_line(tmp_path):
    path = network(tmp_path / "n.onnx", "yolo")
    text = tmp_path / "text.onnx"
    text.write_text("no network", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"needs a table \"network\" with model"):
        make_detector(dataclasses.replace(DEFAULT_TARGETS["bird"], detector="onnx"), 25.0)
    for config, message in (
        ({"path": tmp_path / "gone.onnx"}, "no such file"),
        ({"path": tmp_path}, "no such file"),
        ({"path": text}, "is no ONNX file$"),
        ({"path": path, "input_px": (64, 64)}, "takes images of 96 x 64 px; correct network.input_px"),
        ({"path": path, "classes": (0, 80)}, "has classes 0 to 2, and not 80; correct network.classes"),
        ({"path": path, "layout": "ssd"}, 'gives output \\(1, 7, 6\\); layout "ssd" has '),
        (
            {"path": network(tmp_path / "5.onnx", "yolov5")},
            'gives output \\(1, 6, 8\\); layout "yolo" has \\(1, 4 \\+ classes, n\\), with scores',
        ),
    ):
        with pytest.raises(ConfigError, match=message) as caught:
            detector(**config)
        assert "\n" not in str(caught.value)


def test_the_doctor_loads_the_networks_of_targets(tmp_path):
    network(tmp_path / "n.onnx", "yolo")
    gull = {"size": 1.0, "dimension": "width", "wanted_px": 100.0, "detector": "onnx"}
    files = {"gull": "n.onnx", "tern": "gone.onnx"}
    targets = {name: {**gull, "network": {"model": str(tmp_path / file)}} for name, file in files.items()}
    found = {each.name: each for each in examine(parse_config({"targets": targets, "backend": "hardware"}))}
    assert found["targets.gull.detector"].ok
    assert found["targets.gull.detector"].text.endswith("n.onnx, 96x64 px, run by OpenCV")
    assert found["targets.tern.detector"].text.endswith(
        "gone.onnx: no such file; network.model is a network as an ONNX file"
    )


def test_rig_toml_names_the_network_beside_it(tmp_path):
    table = {"size": 1.0, "dimension": "width", "wanted_px": 100.0, "detector": "onnx"}
    network_table = {"model": "n.onnx", "classes": [14], "least_score": 0.3, "input_px": [640, 384], "tiled": True}
    config = parse_config({"targets": {"gull": {**table, "network": network_table}}}, tmp_path)
    network = config.target("gull").network
    assert network == NetworkConfig(tmp_path / "n.onnx", "yolo", (640, 384), (14,), 0.3, True)
    for wrong, message in (
        ({"layout": "yolo"}, "targets.gull.network.model: Field required"),
        (
            {"model": "n.onnx", "layout": "?"},
            "targets.gull.network.layout: '?' should be 'yolo', 'yolov5', 'yolov10', 'ssd'",
        ),
        ({"model": "n.onnx", "classes": [-1]}, "targets.gull.network.classes"),
        ({"model": "n.onnx", "std": [1, 0, 1]}, "targets.gull.network.std"),
        ({"model": "n.onnx", "size": 3}, "unknown key 'targets.gull.network.size'"),
    ):
        with pytest.raises(ConfigError) as caught:
            parse_config({"targets": {"gull": {**table, "network": wrong}}})
        assert message in str(caught.value)
    for alone in (table, {**table, "detector": "auto", "network": {"model": "n.onnx"}}):
        with pytest.raises(ConfigError, match=r'^targets.gull: detector = "onnx" and a table .* need each other$'):
            parse_config({"targets": {"gull": alone}})
