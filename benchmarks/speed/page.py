"""The results as a page of Markdown: what was measured, beside whom, and beside what the machine can do."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from workloads import AGENT, LOADS, Cost, step_cost

IN_FULL = 0.1
"""Below this share of every limit, neither arithmetic nor memory is what takes the time."""

ONE_MODEL = ("ours, one model", "ours, one model, XLA only")


def page(result: Mapping[str, Any]) -> str:
    """Return the page of a result, with the parts that it has."""
    parts = [_head(result)]
    parts += [_load(part, result) for part in sorted(LOADS) if part in result]
    others = {"seeds": _seeds, "W5": _acting, "W6": _training, "long": _long, "growth": _growth}
    parts += [write(result) for name, write in others.items() if name in result]
    problems = [f"- {part}: {why}" for part, why in result.get("problems", {}).items() if why]
    if problems:
        parts.append("\n".join(["## What went wrong", "", *problems]))
    return "\n\n".join(parts) + "\n"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table, its first column and notes to the left and the others to the right.

    >>> print(table(["who", "ms"], [["ours", "1"]]))
    | who | ms |
    | --- | ---: |
    | ours | 1 |
    """
    sides = ["---" if i == 0 or name == "note" else "---:" for i, name in enumerate(head)]
    lines = [head, sides, *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def number(value: float | None, digits: int = 3) -> str:
    """Write a number with so many digits that count, and thousands apart; nothing known is a dash.

    >>> number(1234.5), number(0.01234), number(None)
    ('1,234', '0.0123', '-')
    """
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 10 ** (digits - 1) else f"{value:.{digits}g}"


def percent(share: float) -> str:
    """Write a share in percent: one that a cache lifts over the memory's limit stays as it is."""
    return f"{number(100 * share, 2)} %"


def _head(result: Mapping[str, Any]) -> str:
    limit = result.get("limits", {})
    device = result.get("device", "cpu")
    where = result.get("machine", "") if device == "cpu" else f"{device} ({result.get('machine', '')})"
    full, default = limit.get("gflops"), limit.get("gflops_default")
    rounded = "" if default is None else f" ({number(default)} in JAX's default precision)"
    known = ", ".join(f"{name} {version}" for name, version in result.get("versions", {}).items())
    return f"""# Speed: {where}

`{result.get("command", "")}`; {known}. float32 throughout.

What the machine can do, measured in the same run: {number(full)} GFLOP/s in a large matrix product
of full float32 precision{rounded}, {number(limit.get("gbytes"))} GB/s of memory read and written. Times are
medians of rounds in which everyone takes turns. A share of a limit counts only what the task cannot do
without: `6 N^2` operations a step of an E-step, and each likelihood, belief and posterior moved once. Where
both shares are small, what takes the time is that steps follow one another.

![figures]({result["name"]}.png)"""


def _load(part: str, result: Mapping[str, Any]) -> str:
    found, load, limit = result[part], LOADS[part], result.get("limits", {})
    head = ["who", "ms", "times ours", "compiling, s", "memory, MiB", "of GEMM", "of bandwidth", "note"]
    rows = []
    for who, row in found["contestants"].items():
        seconds = row["milliseconds"] / 1e3
        shares = _shares(Cost(load.flop, load.bytes), 1 / seconds, limit)
        taken = [number(row[name]) for name in ("milliseconds", "times_ours", "compile_seconds")]
        memory = number(row.get("peak_mebibytes") or None)
        rows.append([who, *taken, memory, *map(percent, shares), row["note"]])
    lines = [f"## {part}: one E-step, {found['what']}", "", table(head, rows)]
    error = found.get("float32_error", {})
    if "counts" in error:
        errors = f"{error['log_evidence']:.1e} of a log-evidence, {error['counts']:.1e} of the largest count"
        lines += ["", f"Largest errors of ours against float64: {errors}."]
    return "\n".join([*lines, *_left_out(found)])


def _left_out(found: Mapping[str, Any]) -> list[str]:
    missing = [f"{who} ({why})" for who, why in found.get("left_out", {}).items()]
    return ["", f"Left out: {'; '.join(missing)}."] if missing else []


def _shares(cost: Cost, per_second: float, limit: Mapping[str, float]) -> tuple[float, float]:
    """Return what doing something so often a second is of the machine's arithmetic, and of its bandwidth."""
    peak, width = (1e9 * limit.get(name, math.inf) for name in ("gflops", "gbytes"))
    return cost.flop * per_second / peak, cost.bytes * per_second / width


def bound(arithmetic: float, bandwidth: float) -> str:
    """Say what limits a time of which these are the shares."""
    if max(arithmetic, bandwidth) < IN_FULL:
        return "latency"
    if bandwidth > 1:
        return "cache"
    return "arithmetic" if arithmetic > bandwidth else "bandwidth"


def _seeds(result: Mapping[str, Any]) -> str:
    found, limit = result["seeds"], result.get("limits", {})
    plans = list(dict.fromkeys(plan for row in found["rows"] for plan in row["milliseconds"]))
    told = ("models a second", "of GEMM", "of bandwidth", "bound by")
    head = ["models", *[f"{plan}, ms" for plan in plans], *told]
    rows = []
    for row in found["rows"]:
        load = LOADS["W2"]._replace(models=row["models"])
        shares = _shares(Cost(load.flop, load.bytes), row["models_per_second"] / load.models, limit)
        taken = [number(row["milliseconds"].get(plan)) for plan in plans]
        fastest = [number(row["models_per_second"]), *map(percent, shares), bound(*shares)]
        rows.append([f"{row['models']:,}", *taken, *fastest])
    lines = [f"## Many models: one E-step, each of {found['what']}", "", table(head, rows)]
    if found["rows"]:
        best = max(found["rows"], key=lambda row: row["models_per_second"])
        most = max(row["models"] for row in found["rows"])
        lines += ["", f"Most models a second at {best['models']:,}; {most:,} was the most that ran."]
    lines += [f"Plan {plan} stopped at {why}." for plan, why in found["failed"].items()]
    return "\n".join(lines)


def _acting(result: Mapping[str, Any]) -> str:
    found, limit = result["W5"], result.get("limits", {})
    rows = []
    for count in sorted(map(int, (key for key in found if key.isdigit()))):
        for who, rate in found[str(count)].items():
            costs = {**dict.fromkeys(ONE_MODEL, False), "ours, a model each": True}
            shares = _shares(step_cost(own_model=costs[who]), rate, limit) if who in costs else None
            told = ["-"] * 3 if shares is None else [*map(percent, shares), bound(*shares)]
            rows.append([who, f"{count:,}", number(rate), *told])
    shared, own = step_cost(own_model=False), step_cost(own_model=True)
    text = f"""## W5: agents in the 89-state maze, N = {AGENT.states}, SARSA(lambda)

{table(["who", "agents", "steps a second", "of GEMM", "of bandwidth", "bound by"], rows)}

A step needs {shared.flop:,.0f} operations, and {shared.bytes:,.0f} bytes of values, traces and beliefs; with
a model of its own {own.bytes:,.0f} bytes, most of them the matrix of the action. Below {percent(IN_FULL)} of
both limits it waits for the step before; above 100 % of the bandwidth, numbers came from a cache."""
    return "\n".join([text, *_left_out(found)])


def _training(result: Mapping[str, Any]) -> str:
    found = result["W6"]
    names = list(dict.fromkeys(name for row in found.values() for name in row))
    rows = [[kind, *[number(row.get(name)) for name in names]] for kind, row in found.items()]
    return f"""## W6: a whole training run, 21 seeds of 1,000 trials in the 89-state maze, seconds by part

{table(["cache", *names], rows)}"""


def _long(result: Mapping[str, Any]) -> str:
    found = result["long"]["milliseconds"]
    lengths = sorted({int(steps) for times in found.values() for steps in times})
    rows = [[f"{n:,}", *[number(times.get(str(n))) for times in found.values()]] for n in lengths]
    return f"""## One long tape: one E-step, N = {result["long"]["states"]}, ms

{table(["T", *found], rows)}

Who would take over 5 s for a length sits it out."""


def _growth(result: Mapping[str, Any]) -> str:
    base = "each size alone, the others S = 4, B = 16, T = 64, N = 16, A = 4"
    rows = []
    for letter, curve in result["growth"].items():
        for who, times in curve["milliseconds"].items():
            pairs = zip(curve["sizes"], times, strict=False)
            rows.append([f"{letter}, {who}", ", ".join(f"{size:,}: {number(ms)}" for size, ms in pairs)])
    return f"## Growth of one E-step, ms: {base}\n\n{table(['size', 'ms'], rows)}"
