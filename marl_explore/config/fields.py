"""Types of settings: what the fields of a dataclass declare is required of their values.

Every settings class calls ``check_types`` before it checks ranges, and files of settings are read
by ``read_fields``, so a wrong value gives the same error wherever it comes from.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from marl_explore.config.checks import MAX_INTEGER, is_integer, require

Settings = TypeVar("Settings")

_NAMES = {
    int: "an integer",
    float: "a number, not NaN",
    bool: "true or false",
    str: "text",
    Path: "a path",
    dict: "an object",
    NoneType: "None",
}


def check_types(settings: Any) -> None:
    """Require that every field of a dataclass has a value of its declared type.

    Raises:
        ValueError: naming the field, its value and the type, also for NaN and for integers that
            need more than 64 bits.
    """
    for name, hint in _hints(type(settings)).items():  # type: ignore[arg-type]
        check_type(name, getattr(settings, name), hint)


def check_type(name: str, value: object, hint: Any) -> None:
    """Require that the value of one field has its declared type; as ``check_types``."""
    if _fits(value, hint):
        return
    allowed = _describe(hint)
    if isinstance(value, int) and abs(value) > MAX_INTEGER:
        allowed += " of at most 64 bits"
    elif hasattr(value, "item"):
        allowed += " of Python: use .item()"
    require(False, name, value, f"it must be {allowed}")


def read_fields(kind: type[Settings], values: object, where: str) -> Settings:
    """A dataclass of settings from JSON values; lists become tuples.

    Args:
        kind: the dataclass.
        values: a JSON object with its fields; those with a default may be absent.
        where: the file, and the field of it that holds the object, for error messages.

    Raises:
        ValueError: naming ``where`` and the field, for a field that is unknown, missing, of
            another type or out of range.
    """
    if not isinstance(values, Mapping):
        raise ValueError(f"{where} must be an object, and is {values!r}")
    hints = _hints(kind)  # type: ignore[arg-type]
    unknown = [name for name in values if name not in hints]
    if unknown:
        raise ValueError(f"{where} has an unknown field {unknown[0]!r}: it has {sorted(hints)}")
    missing = [
        field.name
        for field in fields(kind)  # type: ignore[arg-type]
        if field.name not in values
        and field.default is MISSING
        and field.default_factory is MISSING
    ]
    if missing:
        raise ValueError(f"{where} has no field {missing[0]!r}")
    read = {
        name: read_fields(hints[name], value, f"{where}, {name}")
        if isinstance(value, Mapping) and is_dataclass(hints[name])
        else _tuples(value)
        for name, value in values.items()
    }
    try:
        return kind(**read)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


@lru_cache
def _hints(kind: Any) -> dict[str, Any]:
    """The declared types of a dataclass's fields."""
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in fields(kind)}


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _fits(value: Any, hint: Any) -> bool:
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _fits(value, parts[0])
    if origin is Literal:
        return any(value is part or (type(value) is type(part) and value == part) for part in parts)
    if origin in (Union, UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is tuple:
        return isinstance(value, tuple) and all(_fits(entry, parts[0]) for entry in value)
    if hint is Any:
        return True
    if hint is float:
        return is_integer(value) or (isinstance(value, float) and value == value)
    if hint is int:
        return is_integer(value) and abs(value) <= MAX_INTEGER
    return isinstance(value, origin or hint)


def _describe(hint: Any) -> str:
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _describe(parts[0])
    if origin is Literal:
        return f"one of {parts}"
    if origin in (Union, UnionType):
        kinds = [_describe(part) for part in parts]
        return ("; or " if any("," in kind for kind in kinds) else " or ").join(kinds)
    if origin is tuple:
        return f"a list, each entry {_describe(parts[0])}"
    return _NAMES.get(origin or hint, f"of type {getattr(hint, '__name__', hint)}")
