"""What a disturbance or a sensor's noise can do to each signal: the proved bound against the worst that is found.

    .venv/bin/python -m benchmarks.bounds [spec …]

The worst is sought over the switching between all pairs of cells and over the input, which the proof allows for: see
`worst` in tests/promises.py. A ratio below 1 would be a false proof.
"""

import sys
import time
from pathlib import Path

from rich.console import Console

from pwatrack import design, load_spec
from pwatrack.report.figures import channel_text, signal_text
from tests.promises import joint_system, worst


def main(paths: list[Path]) -> None:
    """Print a line for each channel and signal, and the time that the bounds took."""
    console = Console(width=140)
    for path in paths:
        spec = load_spec(path)
        controller = design(spec)
        rate = controller.guarantees.rate
        begin = time.perf_counter()
        found = controller.bounds
        console.print(f"{path}: {time.perf_counter() - begin:.2f} s")
        for bounds in found:
            M, g, rows = joint_system(controller, bounds)
            on, _ = channel_text(spec, bounds.channel)
            for signal, size in bounds.sizes.items():
                if signal[0] == "estimate":
                    continue
                seen = worst(M, g, rows[signal], duration=8 / rate)
                name, _ = signal_text(spec, signal)
                console.print(f"    {on} → {name}: bound {size:.4g}, found {seen:.4g}, ratio {size / seen:.2f}")


if __name__ == "__main__":
    main(
        [Path(name) for name in sys.argv[1:]]
        or sorted(Path("specs").glob("*.yaml")) + sorted(Path("specs/gallery").glob("*.yaml"))
    )
