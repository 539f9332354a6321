"""Scripts that make what stands in the docs still run."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_the_timing_script_prints_a_documented_row_for_each_preset():
    few = ["--batch", "2", "--repeat", "1", "--presets", "cpu"]
    done = subprocess.run(
        [sys.executable, "scripts/time_denoisers.py", *few],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    page = (ROOT / "docs" / "architectures.md").read_text()
    rows = re.findall(r"^(\| .+ \| `cpu` \| [\d,]+ \|)", done.stdout, flags=re.MULTILINE)
    assert len(rows) == 4
    for row in rows:  # architecture, preset and number of weights; times differ
        assert row in page
