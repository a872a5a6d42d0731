"""Specs of a mass on a spring that differ in little, and specs that differ in what is simulated."""

from dataclasses import replace
from typing import Any

from pwatrack import Spec


def in_scenario(spec: Spec, **changes: Any) -> Spec:
    """Return the spec with some attributes of its scenario changed."""
    return replace(spec, scenario=replace(spec.scenario, **changes))


STOP = "{name: stop, kind: spring, of: z, start: 1, slope: 0.3, into: {v: -1}}"


TWO = """
name: Two stages
system:
  states: [x, v, z, w]
  inputs: [u, f]
  outputs: [y1, y2]
  A: [[0, 1, 0, 0], [-2, -0.5, 0, 0], [0, 0, 0, 1], [0, 0, -3, -0.7]]
  nonlinearities:
    - {name: bumper, kind: dead_zone, of: x, lower: -0.1, upper: 0.1, slope: 3, into: {v: -1}}
    - {name: stop, kind: dead_zone, of: z, lower: -0.1, upper: 0.1, slope: 4, into: {w: -1}}
  B: [[0, 0], [1, 0], [0, 0], [0, 1]]
  C: [[1, 0, 0, 0], [0, 0, 1, 0]]
design: DESIGN
reference: {output: {y1: 0.4*sin(0.8*t), y2: 0.3*sin(t)}}
simulation: {duration: 20, sample_time: 0.01, MORE}
"""


def mass(
    *elements: str,
    head: str = "name: mass",
    A: str = "[[0, 1], [-1, -1]]",
    B: str = "[[0], [1]]",
    C: str = "[[1, 0]]",
    design: str = "{}",
    reference: str = '{output: "0.1*sin(t)"}',
    simulation: str = "{duration: 1, sample_time: 0.1}",
) -> str:
    """Return the spec of one: its place z and speed v, and elements between them."""
    listed = "".join(f"\n    - {element}" for element in elements)
    between = f"\n  nonlinearities:{listed}" if elements else ""
    return f"""{head}
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  A: {A}
  B: {B}
  C: {C}{between}
design: {design}
reference: {reference}
simulation: {simulation}
"""
