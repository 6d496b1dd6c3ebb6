"""Networks from ONNX files by CasADi's importer, as the guide has it."""

import casadi as ca
import numpy as np
import pytest
from small_tasks import objective_of

import symgraph as sg

onnx = pytest.importorskip("onnx")
if not hasattr(ca, "GraphBuilder"):
    pytest.skip("CasADi before 3.8 does not read ONNX", allow_module_level=True)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """Two layers, tanh between them, in single precision."""
    from onnx import TensorProto, helper, numpy_helper

    rng = np.random.default_rng(0)
    shapes = {"w": (2, 8), "b": (8,), "v": (8, 1), "c": (1,)}
    weights = [
        numpy_helper.from_array(rng.normal(size=shape).astype(np.float32), name) for name, shape in shapes.items()
    ]
    nodes = [
        helper.make_node("Gemm", ["input", "w", "b"], ["h"]),
        helper.make_node("Tanh", ["h"], ["t"]),
        helper.make_node("Gemm", ["t", "v", "c"], ["output"]),
    ]
    inputs, outputs = (
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, (1, n))] for name, n in (("input", 2), ("output", 1))
    )
    model = helper.make_model(
        helper.make_graph(nodes, "net", inputs, outputs, weights), opset_imports=[helper.make_opsetid("", 17)]
    )
    model.ir_version = 9
    path = tmp_path_factory.mktemp("onnx") / "net.onnx"
    onnx.save(model, path)
    return str(path)


def reference(file, row):
    from onnx.reference import ReferenceEvaluator

    return ReferenceEvaluator(file).run(None, {"input": np.asarray([row], dtype=np.float32)})[0][0, 0]


@pytest.mark.parametrize("compiled", [False, True])
def test_a_plain_function_of_an_imported_network(file, compiled):
    net = ca.GraphBuilder(file).create("net", {"symbolic": True})

    def push(force, mass):
        return {"moved": ca.vec(net(ca.vertcat(force, mass)))}

    graph = sg.Graph({"force": sg.Action(low=-1, high=1), "mass": sg.State(), "moved": sg.State()}, start="before")
    graph.edge("before", "after", push)
    graph.reward("after", lambda moved: moved)
    objective = objective_of(graph, compiled=compiled)
    values, gradients = objective.evaluate({"mass": 0.3}, np.array([[0.2, 0.2 + 1e-5, 0.2 - 1e-5]]))
    assert values[0] == pytest.approx(reference(file, [0.2, 0.3]), abs=1e-6)
    assert gradients[0, 0] == pytest.approx((values[1] - values[2]) / 2e-5, rel=1e-6)
    plan = sg.solve(objective, {"mass": sg.Gaussian(0.3, sd=0.1)})
    assert plan.nodes[-1].states["moved"].covariance > 0.0
