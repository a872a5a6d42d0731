"""Specs that differ in what is simulated."""

from dataclasses import replace
from typing import Any

from pwatrack import Spec


def in_scenario(spec: Spec, **changes: Any) -> Spec:
    """Return the spec with some attributes of its scenario changed."""
    return replace(spec, scenario=replace(spec.scenario, **changes))
