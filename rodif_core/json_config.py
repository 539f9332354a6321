"""Frozen configurations that survive a trip through JSON. Imports neither torch nor mujoco."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any, Self

from rodif_core.errors import UnknownNameError, ValueOutOfRangeError


class JsonConfig:
    """Mapping to and from plain JSON types for a frozen dataclass whose fields have defaults.

    The default tells a field's type; a default of None stands for a number that may be missing.
    """

    def to_json(self) -> dict[str, Any]:
        """Plain dict of JSON types; `from_json` gives back an equal object."""
        assert dataclasses.is_dataclass(self)
        plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self)))
        return plain

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Build and check. Raises UnknownNameError for a field that does not exist, and
        ValueOutOfRangeError for a value of another type than the field's, or out of range."""
        assert dataclasses.is_dataclass(cls)
        defaults = cls()
        names = [item.name for item in dataclasses.fields(cls)]
        for name, value in data.items():
            if name not in names:
                raise UnknownNameError(f"{cls.__name__} field", name, names)
            default = getattr(defaults, name)
            if not _fits(value, default):
                raise ValueOutOfRangeError(name, value, _legal_type(default))
        return cls(**{k: tuple(v) if isinstance(v, list) else v for k, v in data.items()})


def _legal_type(default: object) -> str:
    if isinstance(default, bool):
        return "true or false"
    if isinstance(default, int):
        return "a whole number"
    if isinstance(default, float):
        return "a finite number"
    if default is None:
        return "a finite number or null"
    if isinstance(default, str):
        return "text"
    return "a list of finite numbers" if isinstance(default, tuple) else "an object"


def _fits(value: object, default: object) -> bool:
    if isinstance(default, bool):
        return isinstance(value, bool)
    if isinstance(default, int):
        return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63
    if isinstance(default, float):
        return _is_number(value)
    if default is None:
        return value is None or _is_number(value)
    if isinstance(default, str):
        return isinstance(value, str)
    if isinstance(default, tuple):
        return isinstance(value, list | tuple) and all(_is_number(item) for item in value)
    return isinstance(value, Mapping)


def _is_number(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < 2**63 if isinstance(value, int) else math.isfinite(value)
