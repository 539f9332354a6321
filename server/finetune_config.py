"""From the partial JSON that a client sends to a complete, checked FinetuneConfig."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from rodif_core.errors import UnknownNameError, ValueOutOfRangeError
from rodif_core.spec import FinetuneConfig, GuideConfig


def complete_config(partial: Mapping[str, Any], *, method: str) -> FinetuneConfig:
    """Fill in defaults (`method` is the campaign's) and check every field.

    Raises UnknownNameError or ValueOutOfRangeError with the offending value and the legal ones.
    """
    merged: dict[str, Any] = {"method": method, **partial}
    _check_types(merged, FinetuneConfig())
    guide = merged.get("guide")
    if guide is not None:
        _check_types(guide, GuideConfig())
    return FinetuneConfig.from_json(merged)


def _check_types(given: Mapping[str, Any], default: FinetuneConfig | GuideConfig) -> None:
    """The dataclasses check ranges of numbers; JSON can also bring text where a number belongs."""
    names = [field.name for field in dataclasses.fields(default)]
    for name, value in given.items():
        if name not in names:
            raise UnknownNameError(f"{type(default).__name__} field", name, names)
        if value is None and name == "conservativeness":
            continue
        expected = getattr(default, name)
        legal = _legal_type(expected)
        if not _fits(value, expected):
            raise ValueOutOfRangeError(name, value, legal)


def _legal_type(expected: object) -> str:
    if isinstance(expected, bool):
        return "true or false"
    if isinstance(expected, int):
        return "a whole number"
    if isinstance(expected, float) or expected is None:
        return "a finite number"
    if isinstance(expected, str):
        return "text"
    return "a list of finite numbers" if isinstance(expected, tuple) else "an object"


def _fits(value: object, expected: object) -> bool:
    if isinstance(expected, bool):
        return isinstance(value, bool)
    if isinstance(expected, int):
        return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63
    if isinstance(expected, float) or expected is None:
        return _is_number(value)
    if isinstance(expected, str):
        return isinstance(value, str)
    if isinstance(expected, tuple):
        return isinstance(value, list | tuple) and all(_is_number(item) for item in value)
    return isinstance(value, Mapping)


def _is_number(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < 2**63 if isinstance(value, int) else math.isfinite(value)
