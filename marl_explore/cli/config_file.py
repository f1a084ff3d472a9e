"""Options from a YAML or JSON file: ``--config FILE``, for every subcommand.

Keys are the names of flags, with - or _. Groups of them, as in a run's own ``config.json``, are
read as if they were not grouped. Flags on the command line replace what the file says.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, fields, is_dataclass, replace
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import tyro
import yaml

from marl_explore.config.fields import check_type
from marl_explore.policies.migrate import migrated
from marl_explore.utils.json_files import read_json

FLAG = "--config"
Arguments = TypeVar("Arguments")


class ConfigFile:
    """The options of a file, each to be taken once.

    Args:
        path: YAML, or JSON when it ends in .json.

    Raises:
        ValueError: naming the file, when it cannot be read or is not a mapping of options.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.options = _flat(migrated(_read(self.path)), self.path)

    def get(self, name: str) -> Any:
        """The value of an option, which is not taken by this; None if it has none."""
        return self.options.get(name)

    def new(self, kind: type[Arguments], **given: Any) -> Arguments:
        """Arguments of a kind with the options of the file; those that are required may be absent.

        Raises:
            ValueError: naming file and option, for one that is unknown, of another type or out of
                range.
        """
        required = {
            field.name: tyro.MISSING
            for field in fields(kind)  # type: ignore[arg-type]
            if field.default is MISSING and field.default_factory is MISSING
        }
        hints = get_type_hints(kind, include_extras=True)
        known = {n: self._value(n, hints[n]) for n in required if n in self.options}
        return self.fill(kind(**required | known | given))

    def fill(self, settings: Arguments) -> Arguments:
        """Settings with the options of the file in place of their own; as ``new``."""
        taken: set[str] = set()
        filled = self._filled(settings, taken)
        unknown = sorted(self.options.keys() - taken)
        if unknown:
            raise ValueError(f"{self.path}: unknown option {unknown[0]!r}; it has {sorted(taken)}")
        return filled

    def _filled(self, settings: Any, taken: set[str]) -> Any:
        hints = get_type_hints(type(settings), include_extras=True)
        changes: dict[str, Any] = {}
        for field in fields(settings):
            value = getattr(settings, field.name)
            if is_dataclass(value):
                changes[field.name] = self._filled(value, taken)
            elif field.name in self.options:
                taken.add(field.name)
                changes[field.name] = self._value(field.name, hints[field.name])
        try:
            return replace(settings, **changes)
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}") from error

    def _value(self, name: str, hint: Any) -> Any:
        """The value of an option in its type."""
        value = _converted(self.options[name], hint)
        try:
            check_type(name, value, hint)
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}") from error
        return value


def take_config(words: Sequence[str]) -> tuple[list[str], ConfigFile | None]:
    """A command line without ``--config FILE``, and that file.

    Raises:
        ValueError: when the flag is given twice or without a file, and as for ``ConfigFile``.
    """
    rest, paths = [], []
    remaining = iter(words)
    for word in remaining:
        flag, equals, value = word.partition("=")
        if flag != FLAG:
            rest.append(word)
            continue
        path = value if equals else next(remaining, "")
        if not path or path.startswith("--"):
            raise ValueError(f"{FLAG} is not allowed without a file")
        paths.append(path)
    if len(paths) > 1:
        raise ValueError(f"{FLAG} is not allowed twice: {paths}")
    return rest, ConfigFile(paths[0]) if paths else None


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise ValueError(f"{path} cannot be read: it is no file")
    if path.suffix == ".json":
        return read_json(path)
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError, ValueError) as error:
        raise ValueError(f"{path} cannot be read as YAML: {error}") from error
    if not isinstance(content, dict):
        kind = type(content).__name__
        raise ValueError(f"{path} must be a mapping of options, and is a {kind}")
    return content


class _Loader(yaml.SafeLoader):
    """Safe YAML, in which no key may stand twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value]
        if twice := [str(key) for key in keys if keys.count(key) > 1]:
            raise ValueError(f"the key {twice[0]!r} stands there twice")
        return super().construct_mapping(node, deep)


def _flat(content: Mapping[Any, Any], path: Path) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in content.items():
        name = str(key).replace("-", "_")
        found = _flat(value, path) if isinstance(value, Mapping) else {name: value}
        if twice := flat.keys() & found.keys():
            raise ValueError(f"{path} has the option {min(twice)!r} twice")
        flat |= found
    return flat


def _converted(value: Any, hint: Any) -> Any:
    """A value as the type of its option asks: YAML knows neither tuples nor paths nor 1e-3."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _converted(value, parts[0])
    if origin in (Union, UnionType):
        kinds = [part for part in parts if part is not type(None)]
        lists = [kind for kind in kinds if get_origin(kind) is tuple]
        kind = lists[0] if isinstance(value, list) and lists else kinds[0]
        return None if value is None else _converted(value, kind)
    if origin is tuple:
        entries = value if isinstance(value, list) else [value]
        return tuple(_converted(entry, parts[0]) for entry in entries)
    if hint is float and isinstance(value, str):
        with suppress(ValueError):
            return float(value)
    if hint is str and isinstance(value, (int, float)) and not isinstance(value, bool):
        return str(value)
    if hint is Path and isinstance(value, str):
        return Path(value)
    return value
