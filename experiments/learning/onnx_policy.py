"""Write a policy as an ONNX file with its normalisation inside, for `cotarget follow` and any other runtime."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cotarget.control.policy import ENVIRONMENT, TASK_FEATURES

Layer = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]  # weights (out, in) and biases (out,)


def write_policy(
    path: Path, layers: Sequence[Layer], mean: npt.ArrayLike, scale: npt.ArrayLike, clip: float, action: str
) -> None:
    """Write a network with tanh between its layers, whose actions are 0 without a confirmed track.

    Args:
        path: file to write.
        layers: layers from the features to the action.
        mean: mean of each feature.
        scale: what a feature less its mean is multiplied by.
        clip: largest absolute value of a normalised feature.
        action: what its actions mean in `ENVIRONMENT`, "rates" or "residual".
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    own, nodes = [], []

    def constant(name: str, value: npt.ArrayLike) -> str:
        own.append(numpy_helper.from_array(np.asarray(value, dtype=np.float32), name))
        return name

    def node(kind: str, inputs: Sequence[str], output: str, **attributes: float) -> str:
        nodes.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    value = node("Sub", ["features", constant("mean", mean)], "centred")
    value = node("Mul", [value, constant("scale", scale)], "scaled")
    value = node("Clip", [value, constant("low", -clip), constant("high", clip)], "normalised")
    for i, (weights, biases) in enumerate(layers):
        last = i == len(layers) - 1
        inputs = [value, constant(f"weights{i}", weights), constant(f"biases{i}", biases)]
        value = node("Gemm", inputs, f"layer{i}", transB=1)
        value = value if last else node("Tanh", [value], f"tanh{i}")
    value = node("Clip", [value, constant("lowest", -1.0), constant("highest", 1.0)], "bounded")
    only_known = np.zeros((3, len(TASK_FEATURES)))
    only_known[:, list(TASK_FEATURES).index("known")] = 1.0
    known = node("Gemm", ["features", constant("only_known", only_known)], "known", transB=1)
    node("Mul", [value, known], "action")
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", size])
        for name, size in (("features", len(TASK_FEATURES)), ("action", 3))
    ]
    graph = helper.make_graph(nodes, "policy", ends[:1], ends[1:], own)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, {"environment": ENVIRONMENT, "action": action})
    onnx.checker.check_model(model)
    onnx.save(model, path)
