"""Paths in a spec: as an engineer reads them, and what stands there."""

from typing import Any

from pwatrack.causes import Subject

_LONGEST_PART = 100  # characters of one key in a path


def path_text(subject: Subject) -> str:
    """Return a path as an engineer reads it, counted from 1.

    Example:
        >>> path_text(("system", "cells", 1, "A", 0))
        'system.cells[2].A[1]'
    """
    text = ""
    for part in subject:
        name = part if isinstance(part, str) and len(part) <= _LONGEST_PART else f"{str(part)[:_LONGEST_PART]}…"
        text += f"[{part + 1}]" if isinstance(part, int) else f".{name}" if text else name
    return text or "the file"


def at_path(data: Any, subject: Subject) -> Any:
    """Return what stands in a tree at a path, None for nothing.

    Example:
        >>> at_path({"cells": [{"A": "1"}, {"A": "2"}]}, ("cells", 1, "A")), at_path({}, ("cells", 1))
        ('2', None)
    """
    for part in subject:
        if isinstance(data, dict):
            data = data.get(str(part))
        else:
            data = data[part] if isinstance(data, list) and isinstance(part, int) else None
    return data
