"""The paths of other runs on the page of one."""

import base64
import json
import re

import numpy as np
import pinocchio as pin
import pytest

import fflin

pytestmark = pytest.mark.filterwarnings("ignore::fflin.FflinWarning")


@pytest.fixture(scope="module")
def campaign(robots):
    robot = robots["ets_vii"]
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    given = {"q_b": 0.05, "*.mass": 0.1, "q_m": 0.1}
    return fflin.monte_carlo(robot, policy, given, runs=300, duration=2.0, dt=0.02)


@pytest.mark.browser
def test_the_page_has_the_paths_of_base_and_tool(robots, campaign, watch, tmp_path):
    robot, motion = robots["ets_vii"], campaign.replay(299)
    assert motion.urdf_sha256 != robot.urdf_sha256  # it has masses of its own
    path = fflin.visualize(robot, motion, html=tmp_path / "runs.html", cloud=campaign)
    plain = fflin.visualize(motion._robot, motion, html=tmp_path / "one.html")
    text = path.read_text()
    assert len(text) - len(plain.read_text()) < 1.5e6
    data = re.search(r'<script[^>]* id="data"[^>]*>(.*?)</script>', text, re.DOTALL)[1]
    base, tool = json.loads(data)["cloud"]
    assert base["label"] == "base in 240 of 300 runs" and len(base["counts"]) == 240
    points = [
        np.frombuffer(base64.b64decode(each["points"]), "<f4").reshape(-1, 3)
        for each in (base, tool)
    ]
    # The last of all runs is chosen, and is the motion that is shown.
    data, frame = robot.model.createData(), robot.model.getFrameId("tool")
    for q, rows in ((motion.q[-1], [-1, -1]), (motion.q[0], [-base["counts"][-1]] * 2)):
        pin.framesForwardKinematics(robot.model, data, q)
        at = data.oMi[1].translation, data.oMf[frame].translation
        for row, here, there in zip(rows, points, at, strict=True):
            assert here[row] == pytest.approx(there, abs=1e-6)
    page = watch(f"{path.as_uri()}#pause", painted=True)
    lines = "viewer.scene_tree.find(['meshcat', 'cloud', 'tool']).object.children"
    count = page.do(f"{lines}.at(-1).geometry.index.count")
    assert count == 2 * (len(points[1]) - 240)
    assert "tool in 240 of 300 runs" in page.do("document.getElementById('legend').textContent")


@pytest.mark.exhaustive
def test_a_cloud_of_something_else_is_refused(robots, campaign, tmp_path):
    robot, other = robots["ets_vii"], robots["canadarm2"]
    motion = campaign.replay(0)
    campaign.save(tmp_path / "runs.npz")
    for cloud, whose, said in (
        (3, robot, "cloud"),
        (campaign, other, "'canadarm2'"),
        (fflin.Campaign.load(tmp_path / "runs.npz"), robot, "file"),
    ):
        with pytest.raises(fflin.InputError, match=said):
            fflin.visualize(whose, motion, html=tmp_path / "x.html", cloud=cloud)
    assert not (tmp_path / "x.html").exists()
