"""Tubes of what acts on the errors of a sampled loop, as a certificate has them."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from pwatrack.ball_matrix import BallMatrix
from pwatrack.claims.exact_text import TUBE, decimal, double, read_channel, read_signals, signals
from pwatrack.control.bounds import Channel, Form
from pwatrack.lmi.clocked_tubes import Tube

Sizes = Mapping[Channel, float]  # of channels that have a tube, the size that is 1 of each
Tubes = tuple[tuple[Sizes, tuple[Tube, ...]], ...]  # of channels that have one together: the one that says less counts


def told(
    tubes: Iterable[tuple[Sizes, Tube]], forms: Sequence[Form], starts: Sequence[BallMatrix]
) -> Iterator[dict[str, Any]]:
    """Yield an entry of each tube."""
    for of, tube in tubes:
        yield {
            "acts": [
                {"channel": list(channel), "size": decimal(size)}
                | ({"start": starts[channel[1]].transpose().texts[0]} if channel[0] == "start" else {})
                for channel, size in of.items()
            ],
            **TUBE.write(tube),
            "signals": signals(zip(forms, tube.sizes, strict=True)),
        }


def read(entries: Sequence[Any]) -> tuple[list[tuple[Sizes, Tube]], dict[Channel, Any]]:
    """Return the tubes of entries, and the starts that these tell of."""
    starts = dict[Channel, Any]()
    for one in (one for each in entries for one in each["acts"] if "start" in one):
        if starts.setdefault(read_channel(one["channel"]), one["start"]) != one["start"]:
            raise ValueError("tubes tell of different starts")
    found = list[tuple[Sizes, Tube]]()
    for entry in entries:
        tube = TUBE.read(entry, sizes=tuple(size for _, size in read_signals(entry["signals"])))
        found.append(({read_channel(one["channel"]): double(one["size"]) for one in entry["acts"]}, tube))
    return found, starts
