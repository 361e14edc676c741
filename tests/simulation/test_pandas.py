"""Data frames of motions, trajectories and campaigns: the tables that `save` writes."""

import numpy as np
import pytest

import fflin

pandas = pytest.importorskip("pandas")


@pytest.fixture(scope="module")
def robot():
    return fflin.load("cubesat", inputs=[fflin.BaseTorque()])


def test_frames_are_the_tables_of_the_files(robot, tmp_path):
    v0 = fflin.velocity(robot, {"omega_b.z": 0.3})
    motion = fflin.simulate(robot, v0=v0, duration=0.5, dt=0.05)
    campaign = fflin.monte_carlo(
        robot, None, {"q_b.x": 0.01}, runs=3, duration=0.2, dt=0.05
    )
    for made, index in ((motion, "t [s]"), (motion.trajectory(), "t")):
        made.save(tmp_path / "made.csv")
        table = pandas.read_csv(tmp_path / "made.csv")
        frame = made.to_pandas()
        assert frame.index.name == index
        columns = list(frame.columns)
        assert columns == [name for name in table.columns if name in columns]
        assert np.array_equal(frame.to_numpy(), table[columns].to_numpy())
        assert np.array_equal(frame.index, table[index])
    campaign.save(tmp_path / "runs.csv")
    table, frame = pandas.read_csv(tmp_path / "runs.csv"), campaign.to_pandas()
    assert list(frame.columns) == list(table.columns) and list(frame.index) == [0, 1, 2]
    assert np.array_equal(frame.to_numpy(), table.to_numpy(), equal_nan=True)
