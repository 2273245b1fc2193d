# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parser for untrusted JSON with bounded size and depth."""

from __future__ import annotations

import json
from typing import Any

#: Maximum length of a text [characters]: nested lists take 20 times the memory of their text.
MAX_TEXT_LENGTH = 8 << 20
#: Maximum number of values, and of lists and objects among them.
MAX_VALUES, _MAX_CONTAINERS = 4_000_000, 1_500_000
_MAX_DEPTH = 64


def loads(text: str, *, max_length: int = MAX_TEXT_LENGTH, max_values: int = MAX_VALUES, **hooks: Any) -> Any:
    """Parse untrusted JSON. Raises ValueError if it is invalid or exceeds limits of length, depth or number of values.

    Args:
        text: JSON.
        max_length: maximum length of the text [characters].
        max_values: maximum number of values; if it is above the default, as many lists and objects are accepted.
        hooks: keyword arguments of `json.loads`.

    Raises:
        ValueError: if the text is too long, not JSON, too deeply nested, or holds half a surrogate pair, which cannot
            be encoded.
    """
    if len(text) > max_length:
        raise ValueError(f"it has {len(text)} characters, the limit is {max_length}")
    n_containers = text.count("[") + text.count("{")
    n_values = n_containers + text.count(",")
    max_containers = _MAX_CONTAINERS if max_values <= MAX_VALUES else max_values
    if n_containers > max_containers or n_values > max_values:
        raise ValueError(
            f"it has {n_values} values, {n_containers} of them lists; the limits are {max_values} and {max_containers}"
        )
    try:
        content = json.loads(text, **hooks)
    except RecursionError:
        raise ValueError(f"it is nested more than {_MAX_DEPTH} deep") from None
    if n_containers > _MAX_DEPTH:
        _check_depth(content)
    if "\\u" in text:
        try:
            json.dumps(content, ensure_ascii=False).encode()
        except UnicodeEncodeError as error:
            raise ValueError(f"it holds half a surrogate pair: {error.reason}") from None
    return content


def _check_depth(content: Any) -> None:
    level = [content]
    for _ in range(_MAX_DEPTH):
        level = [
            entry
            for value in level
            if isinstance(value, dict | list)
            for entry in (value.values() if isinstance(value, dict) else value)
        ]
        if not level:
            return
    raise ValueError(f"it is nested more than {_MAX_DEPTH} deep")
