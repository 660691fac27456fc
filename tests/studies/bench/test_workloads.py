from dataclasses import replace

import numpy as np
import pytest
from small_robot import LIMIT, SMALL_ROBOT, joint

import kineverse as kv
from kineverse_studies.bench.peers.casadi import CHUNK_SIZE, NumpyGraph, make_casadi_function
from kineverse_studies.bench.workloads import find_benchmark_robot, strip_shapes


def test_a_robot_is_read_without_prefix(tiny):
    robot = find_benchmark_robot(tiny)
    assert [s.path for s in robot.coordinates] == ["elbow", "finger", "lift", "turn"]
    assert [s.path for s in robot.chain] == ["elbow", "lift", "turn"]
    assert "7 links, 5 moving joints" in str(robot)


def test_positions_are_those_of_all_joints(tiny):
    robot = find_benchmark_robot(tiny)
    configurations = robot.configurations(5)
    np.testing.assert_array_equal(configurations, robot.configurations(5))
    positions = robot.positions(configurations)
    assert set(positions) == {"elbow", "finger", "lift", "turn", "thumb"}
    np.testing.assert_allclose(positions["thumb"], 0.1 - 0.5 * positions["finger"])
    np.testing.assert_array_equal(robot.chain_columns(configurations)[:, 1], positions["lift"])


def test_strip_shapes_removes_visuals_and_collisions(robot_file):
    assert "mesh" in SMALL_ROBOT
    text = strip_shapes(robot_file)
    assert "mesh" not in text
    assert text.count("<link") == 7
    assert text.count("<inertial") == 7


def test_an_unsuitable_robot_is_refused(tiny, tmp_path):
    with pytest.raises(kv.errors.UnknownNameError, match="Did you mean 'tip'"):
        find_benchmark_robot(replace(tiny, frame="tipp"))
    with pytest.raises(kv.errors.InvalidValueError, match="'base'; choose another --frame"):
        find_benchmark_robot(replace(tiny, frame="base"))
    with pytest.raises(kv.errors.InvalidValueError, match="'right' is moved by 'thumb', which follows"):
        find_benchmark_robot(replace(tiny, frame="right"))
    with pytest.raises(kv.errors.UnknownNameError, match="no_such_robot"):
        find_benchmark_robot(replace(tiny, robot="no_such_robot"))
    file = tmp_path / "flying.urdf"
    flying = joint("fly", "floating", "tip", "bird", "1 0 0", LIMIT)
    file.write_text(SMALL_ROBOT.replace("</robot>", f'<link name="bird"/>{flying}</robot>'), encoding="utf-8")
    with pytest.raises(kv.errors.InvalidValueError, match="'fly' is floating"):
        find_benchmark_robot(replace(tiny, robot=str(file)))
    document = tmp_path / "small.kv.json"
    kv.load(tiny.robot).save(str(document))
    with pytest.raises(kv.errors.InvalidValueError, match="Peers read URDF"):
        find_benchmark_robot(replace(tiny, robot=str(document)))


@pytest.mark.parametrize("rows", [1, CHUNK_SIZE, 2 * CHUNK_SIZE + 3])
def test_numpy_evaluates_the_graph(tiny, rows):
    robot = find_benchmark_robot(tiny)
    points = robot.chain_columns(robot.configurations(rows))
    outputs = np.zeros((rows, 4, 4)), np.zeros((rows, 6, 3))
    NumpyGraph(make_casadi_function(robot))(points, outputs)
    model = robot.model
    function = kv.compile([model.fk("tip"), model.jacobian("tip")], robot.chain, tier="interpreter")
    for k in {0, rows // 2, rows - 1}:
        for output, wanted in zip(outputs, function(points[k]), strict=True):
            np.testing.assert_allclose(output[k], wanted, rtol=0, atol=1e-14)


def test_a_graph_with_unsupported_operations_is_refused():
    import casadi as ca

    x = ca.SX.sym("x")
    with pytest.raises(kv.errors.CompileError, match="numpy"):
        NumpyGraph(ca.Function("f", [x], [ca.atan(x)]))
