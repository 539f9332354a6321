"""Mode plots: every group of every task has a colour of its own, in the picture and on the site."""

from __future__ import annotations

import io
import re
from pathlib import Path

import pytest
from PIL import Image

from labeling_ui.mode_plot import colours_of_groups, mode_plot
from rodif_core.tasks import TASKS, get_task

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("name", TASKS)
def test_the_legend_has_a_colour_of_its_own_for_each_group(name: str):
    task = get_task(name)
    colours = colours_of_groups(task)
    assert list(colours)[0] == task.preferred_group
    assert set(colours) == {*task.groups, "failed"}
    assert len(set(colours.values())) == len(colours)
    with Image.open(io.BytesIO(mode_plot(task, "nothing yet", []))) as picture:
        drawn = {colour for _, colour in picture.convert("RGB").getcolors(1 << 20)}
    assert set(colours.values()) <= drawn


def test_the_site_has_a_colour_for_each_group_that_is_not_preferred():
    script = (ROOT / "labeling_ui/site/static/behaviour.js").read_text()
    (listed,) = re.findall(r"const OTHER_GROUPS = \[(.+?)\];", script)
    colours = re.findall(r'"(#[0-9a-f]{6})"', listed)
    assert len(set(colours)) == len(colours)
    assert len(colours) >= max(len(task.groups) for task in TASKS.values()) - 1
