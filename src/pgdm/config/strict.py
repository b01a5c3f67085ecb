"""Build frozen dataclasses from plain data, whose names and types must match exactly."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

from pgdm.config.synonyms import meant
from pgdm.errors import ConfigError, UnknownNameError

T = TypeVar("T")

_KIND = {int: "an integer", float: "a number", bool: "true or false", str: "text"}

_LARGEST = {int: 2**63 - 1, float: 1e15}
"""Largest absolute values: an int fits 64 bits, and the square of a float is finite in float32."""


@dataclass(frozen=True)
class ChosenBy:
    """Marks a field whose class depends on one of its keys: ``Annotated[Base, ChosenBy(...)]``."""

    key: str
    """The key, whose value is text."""
    find: Callable[[str], type]
    """Maps the key's value to the class, a subclass of ``Base``; raises ConfigError."""
    names: tuple[str, ...]
    """Known values, for the messages; ``find`` may accept others too."""

    def of(self, data: Mapping[str, object], path: str) -> type:
        """Return the class for some data.

        Raises:
            ConfigError: if the key is missing, its value is unknown or no text, or the data have
                keys of another class.
        """
        where = _join(path, self.key)
        if self.key not in data:
            raise ConfigError(f"missing {where}; one of {', '.join(self.names)}")
        name = str(_value(str, data[self.key], where))
        cls = self.find(name)
        for key in data:
            others = [other for other in self.names if key in _hints(self.find(other))]
            if name in self.names and others and key not in _hints(cls):
                raise ConfigError(
                    f"{_join(path, key)} belongs to {where}={' or '.join(others)}, not to {name}; "
                    f"choose all settings together: {path}={name}"
                )
        return cls


@cache
def _hints(cls: type) -> dict[str, Any]:
    return typing.get_type_hints(cls, include_extras=True)


def build(cls: type[T], data: object, path: str = "") -> T:
    """Build a dataclass, and the dataclasses inside it, from plain data.

    Args:
        cls: the dataclass; its fields may be bool, int, float, str, lists or dataclasses, or a
            union of one of these and None.
        data: a mapping with exactly the fields of ``cls``. A whole number is a valid float, and
            a float without a fraction (1e6) a valid int; nothing else is converted.
        path: dotted key of the data within all settings, for the messages.

    Raises:
        ConfigError: if a key is missing or unknown, or a value has the wrong type.
    """
    if not isinstance(data, Mapping):
        raise ConfigError(f"{path or 'the configuration'}: {_show(data)} is not a set of keys")
    hints = _hints(cls)
    names = [field.name for field in dataclasses.fields(cls)]  # type: ignore[arg-type]
    for key in data:
        if key not in names:
            # Names are compared without the path, which is the same for all of them.
            where = f"key of '{path}'" if path else "key"
            raise UnknownNameError(where, str(key), names, meant=meant(str(key), names))
    missing = [_join(path, name) for name in names if name not in data]
    if missing:
        raise ConfigError(f"missing {', '.join(missing)}; give a value, such as {missing[0]}=...")
    return cls(**{name: _value(hints[name], data[name], _join(path, name)) for name in names})


def _value(hint: Any, value: object, path: str) -> Any:
    origin = typing.get_origin(hint)
    if origin is typing.Annotated:
        base, chosen = typing.get_args(hint)
        return _value(chosen.of(value, path) if isinstance(value, Mapping) else base, value, path)
    if origin in (types.UnionType, typing.Union):
        inner = [option for option in typing.get_args(hint) if option is not type(None)]
        return None if value is None else _value(inner[0], value, path)
    if value is None:
        raise ConfigError(f"{path}: null is not allowed here; it must be {_name(hint)}")
    if origin is list:
        if not isinstance(value, list):
            raise ConfigError(f"{path}: {_show(value)} is not a list, such as {path}=[a,b]")
        (item,) = typing.get_args(hint)
        return [_value(item, entry, f"{path}[{i}]") for i, entry in enumerate(value)]
    if dataclasses.is_dataclass(hint):
        return build(typing.cast(type, hint), value, path)
    return scalar(hint, value, path)


def scalar(kind: type, value: object, path: str) -> bool | int | float | str:
    """Return a bool, int, float or str as the type that a key has.

    Raises:
        ConfigError: if it is of another type, too large or not finite.
    """
    if kind in (int, float) and isinstance(value, int | float) and not isinstance(value, bool):
        if math.isfinite(value) and abs(value) > _LARGEST[kind]:
            raise ConfigError(f"{path}: {_show(value)} is too large; at most {_LARGEST[kind]:.4g}")
        if kind is float and not math.isfinite(value):
            raise ConfigError(f"{path}: {value} is not a finite number")
        if kind is float:
            return float(value)
        if isinstance(value, int) or value.is_integer():
            return int(value)
    elif kind in (bool, str) and isinstance(value, bool | str) and type(value) is kind:
        return value
    hint = f"; write {path}=\"'{value}'\" to mean text" if kind is str else ""
    raise ConfigError(f"{path}: {_show(value)} is not {_name(kind)}{hint}")


def _name(hint: Any) -> str:
    if typing.get_origin(hint) is list:
        return "a list"
    return _KIND.get(hint, "a set of keys")


def _show(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name
