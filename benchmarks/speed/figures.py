"""A page of figures: times beside peers, steps per second, and growth with each size."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from workloads import LOADS

Panel = Callable[[Any], None]
"""Draws on the axes that it is given."""

ACROSS = 4


def draw(result: dict[str, Any], path: Path) -> None:
    """Draw what a result holds."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    panels = list(_panels(result))
    down = max(-(-len(panels) // ACROSS), 1)
    figure, axes = plt.subplots(down, ACROSS, figsize=(4.6 * ACROSS, 4 * down), layout="constrained")
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, panel in zip(axes.flat, panels, strict=False):
        axis.set_axis_on()
        panel(axis)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def _panels(result: Mapping[str, Any]) -> Iterator[Panel]:
    for part in (p for p in sorted(LOADS) if p in result):
        yield partial(_bars, title=f"{part}: milliseconds an E-step", part=result[part])
    for name, one in (("W5", _acting), ("W6", _training), ("seeds", _seeds), ("long", _long)):
        if name in result:
            yield partial(one, part=result[name])
    for letter, curve in result.get("growth", {}).items():
        times = curve["milliseconds"].items()
        curves = {who: dict(zip(curve["sizes"], values, strict=False)) for who, values in times}
        yield partial(_curves, curves=curves, title=f"growth with {letter}: ms an E-step", xlabel=letter)


def _bars(axis: Any, title: str, part: dict[str, Any]) -> None:
    rows = part["contestants"]
    axis.barh(list(rows), [row["milliseconds"] for row in rows.values()])
    axis.set(title=title, xscale="log")
    axis.xaxis.set_minor_formatter("")
    axis.invert_yaxis()


def _curves(axis: Any, curves: Mapping[str, Mapping[Any, float]], **labels: str) -> None:
    """Draw ``name -> size -> value``."""
    for name, curve in curves.items():
        sizes = sorted((int(size), value) for size, value in curve.items())
        if sizes:
            axis.loglog(*zip(*sizes, strict=True), marker="o", label=name)
    axis.set(**labels)
    if axis.lines:
        axis.legend(fontsize=7)


def _acting(axis: Any, part: dict[str, Any]) -> None:
    rows = {count: row for count, row in part.items() if count.isdigit()}
    names = sorted({name for row in rows.values() for name in row})
    curves = {name: {n: row[name] for n, row in rows.items() if name in row} for name in names}
    _curves(axis, curves, title="W5: steps per second", xlabel="agents")


def _training(axis: Any, part: dict[str, Any]) -> None:
    told = ("wall", "all", "compiling", "stopped_after", "trials")
    names = list(dict.fromkeys(name for row in part.values() for name in row if name not in told))
    for place, kind in enumerate(part):
        left = 0.0
        for index, name in enumerate(names):
            spent = part[kind].get(name, 0.0)
            axis.barh(place, spent, left=left, color=f"C{index}", label=name if place == 0 else None)
            left += spent
    axis.set(title="W6: seconds of 1,000 trials x 21 seeds", yticks=range(len(part)), yticklabels=list(part))
    if names:
        axis.legend(fontsize=7)


def _seeds(axis: Any, part: dict[str, Any]) -> None:
    plans = list(dict.fromkeys(plan for row in part["rows"] for plan in row["milliseconds"]))
    curves = {
        plan: {
            row["models"]: row["milliseconds"][plan] / row["models"]
            for row in part["rows"]
            if plan in row["milliseconds"]
        }
        for plan in plans
    }
    _curves(axis, curves, title="ms a model, an E-step like W2's", xlabel="models")


def _long(axis: Any, part: dict[str, Any]) -> None:
    _curves(axis, part["milliseconds"], title="one tape: ms an E-step", xlabel="T")
