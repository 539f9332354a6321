"""One running API for the tests of the commands that speak REST."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.cli.running_api import RunningApi, running_api


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningApi]:
    with running_api(tmp_path_factory.mktemp("api")) as running:
        yield running
