"""Recordings of Aligning: a hollow box that moves, and its target that stays."""

from __future__ import annotations

import numpy as np

from labeling_ui.replay import make_replay
from labeling_ui.scene import scene_model
from rodif_core.demonstrations import make_demonstrations
from rodif_core.spec import TaskName
from rodif_core.tasks import get_task
from tests.ui.test_replay import messages

TASK = get_task(TaskName.ALIGNING_STATE)


def test_recording_shows_the_walls_of_box_and_target_and_moves_the_box_alone() -> None:
    inside, outside = make_demonstrations(TASK, episodes=2, seed=4, preferred_share=0.5)
    recording = make_replay(TASK, inside, outside)
    moved = messages(recording, "SetPositionMessage")
    for side, trajectory in (("A", inside), ("B", outside)):
        objects = TASK.object_poses(trajectory.qpos)
        bodies = [scene_model(TASK).model.body(name).id for name in TASK.objects]
        box, target = (
            [m["position"] for _, m in moved if m["name"] == f"/{side}/b{body}"] for body in bodies
        )
        assert len(box) > 20
        np.testing.assert_allclose(box[-1], objects[-1, 0, :3], atol=1e-4)
        assert len(target) == 1
        np.testing.assert_allclose(target[0], objects[0, 1, :3], atol=1e-4)


def test_box_and_target_have_the_same_four_colours_and_the_target_is_seen_through() -> None:
    model, shapes = scene_model(TASK).model, scene_model(TASK).shapes
    walls = {
        name: [
            shape
            for shape in shapes
            if shape.body == model.body(name).id and "wall" in model.geom(shape.geom).name
        ]
        for name in TASK.objects
    }
    assert [wall.colour for wall in walls["box"]] == [wall.colour for wall in walls["target"]]
    assert len({wall.colour for wall in walls["box"]}) == 4
    assert {wall.opacity for wall in walls["box"]} == {1.0}
    assert all(wall.opacity < 0.5 for wall in walls["target"])
