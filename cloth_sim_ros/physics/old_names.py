# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Old names of public members and arguments, kept for one release.

An old name gives a `DeprecationWarning` that states the new one. docs/migration.md lists them.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

_Class = TypeVar("_Class", bound=type)
_Function = TypeVar("_Function", bound=Callable[..., Any])


def with_old_names(**new_names: str) -> Callable[[_Class], _Class]:
    """Return a class decorator that adds old names of members; reading one warns and returns the new member.

    Args:
        new_names: for each old name, the name of the member.
    """

    def decorate(decorated: _Class) -> _Class:
        for old, new in new_names.items():
            setattr(decorated, old, _OldName(f"{decorated.__name__}.{old}", new))
        return decorated

    return decorate


def with_old_arguments(**new_names: str) -> Callable[[_Function], _Function]:
    """Return a decorator: the function accepts old names of its keyword arguments, with a warning.

    Args:
        new_names: for each old name, the name of the argument.
    """

    def decorate(function: _Function) -> _Function:
        @functools.wraps(function)
        def call(*arguments: Any, **keywords: Any) -> Any:
            for old in new_names.keys() & keywords.keys():
                _warn(f"argument {old} of {function.__qualname__}", new_names[old], stacklevel=2)
                keywords[new_names[old]] = keywords.pop(old)
            return function(*arguments, **keywords)

        return call  # type: ignore[return-value]

    return decorate


def adopt_old_methods(subclass: type, **new_names: str) -> None:
    """Give methods that a subclass overrides under old names their new names, with a warning.

    Args:
        subclass: class of a user, in `__init_subclass__` of a base class.
        new_names: for each old name of a method of the base class, the new one.
    """
    for old, new in new_names.items():
        if old in vars(subclass) and new not in vars(subclass):
            _warn(f"method {old} of {subclass.__name__}", new, stacklevel=3)
            setattr(subclass, new, vars(subclass)[old])


class _OldName:
    """Descriptor of a class member's old name: warns, and returns the member with the new name."""

    def __init__(self, old: str, new: str) -> None:
        self._old, self._new = old, new

    def __get__(self, instance: object | None, owner: type) -> Any:
        if instance is None:  # as for tools that inspect the class
            return getattr(owner, self._new)
        _warn(self._old, self._new, stacklevel=2)
        return getattr(instance, self._new)


def _warn(old: str, new: str, *, stacklevel: int) -> None:
    warnings.warn(
        f"{old} is now {new}; the next release removes the old name", DeprecationWarning, stacklevel=stacklevel + 1
    )
