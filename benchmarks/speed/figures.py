"""A page of figures: times beside peers, steps per second, and growth with each size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from workloads import LOADS


def draw(result: dict[str, Any], path: Path) -> None:
    """Draw what a result holds."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(3, 4, figsize=(18, 12), layout="constrained")
    flat = list(axes.flat)
    for part in (p for p in LOADS if p in result):
        _bars(flat.pop(0), f"{part}: milliseconds an E-step", result[part])
    if "W5" in result:
        _acting(flat.pop(0), result["W5"])
    if "W6" in result:
        _training(flat.pop(0), result["W6"])
    for letter, curve in result.get("growth", {}).items():
        axis = flat.pop(0)
        for who, times in curve["milliseconds"].items():
            axis.loglog(curve["sizes"], times, marker="o", label=who)
        axis.set(title=f"growth with {letter}", xlabel=letter, ylabel="ms an E-step")
        axis.legend()
    for axis in flat:
        axis.set_axis_off()
    figure.savefig(path, dpi=80)
    plt.close(figure)


def _bars(axis: Any, title: str, part: dict[str, Any]) -> None:
    rows = part["contestants"]
    axis.barh(list(rows), [row["milliseconds"] for row in rows.values()])
    axis.set(title=title, xscale="log")
    axis.invert_yaxis()


def _acting(axis: Any, part: dict[str, Any]) -> None:
    names = sorted({name for row in part.values() for name in row})
    for name in names:
        sizes = sorted((int(count), row[name]) for count, row in part.items() if name in row)
        axis.loglog(*zip(*sizes, strict=True), marker="o", label=name)
    axis.set(title="W5: steps per second", xlabel="agents")
    axis.legend(fontsize=7)


def _training(axis: Any, part: dict[str, Any]) -> None:
    names = [name for name in part["warm"] if name not in ("wall", "all", "compiling")]
    for place, kind in enumerate(part):
        left = 0.0
        for index, name in enumerate(names):
            spent = part[kind].get(name, 0.0)
            axis.barh(place, spent, left=left, color=f"C{index}", label=name if place == 0 else None)
            left += spent
    axis.set(title="W6: seconds of 1,000 trials x 21 seeds", yticks=range(len(part)), yticklabels=list(part))
    axis.legend(fontsize=7)
