"""The result of a comparison: what each arm reached, by how much it differs from real scans only,
and a headline."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lidar_synth.geometry.arrays import Float64Array
from lidar_synth.lab.proof.arms import BASE, CONSTANTS, GENERATOR_BUDGET, Row
from lidar_synth.lab.proof.machine import command_line, machine
from lidar_synth.lab.proof.plan import Pair, ProofPlan, count_scans
from lidar_synth.lab.proof.scores import (
    FEWEST_PLACES,
    group_ious,
    interval,
    mean_group_iou,
)
from lidar_synth.lab.proof.trial import LOOKS, TrialOutcome

Results = dict[Pair, dict[Row, TrialOutcome]]
"""{pair: {arm: outcome}} of the complete pairs."""


@dataclass(frozen=True)
class Proof:
    """The result of ``prove``.

    Args:
        values: everything on the page as plain values, as in ``results.json``.

    ``print`` shows the headline and the table in Markdown.
    """

    values: Mapping[str, Any]

    @property
    def headline(self) -> str:
        """The result in a few sentences."""
        return str(self.values["headline"])

    def __str__(self) -> str:
        lines = [
            self.headline,
            "",
            f"| training | mIoU, % | against real only | 95 % interval | better in | {_BUDGET} | "
            "minutes |",
            "|---|---:|---:|---|---|---|---:|",
        ]
        for row in self.values["arms"]:
            cells = (
                row["title"],
                f"{row['miou']:.1f}",
                format_signed(row["difference"]),
                span(row["interval"]),
                row["better_in"],
                row["budget"],
                f"{row['minutes']:.1f}",
            )
            lines.append(f"| {' | '.join(cells)} |")
        return "\n".join(lines)


_BUDGET = "what it uses"


def format_signed(value: float | None) -> str:
    """A difference in percentage points."""
    return "" if value is None else f"{value:+.1f}"


def span(ends: Sequence[float] | None) -> str:
    """An interval of differences."""
    return "–" if ends is None else f"[{ends[0]:+.1f}, {ends[1]:+.1f}]"


def summarise(
    plan: ProofPlan,
    found: Results,
    preparation: Mapping[str, float],
    trainer: str,
    seen: str = "",
) -> Proof:
    """The result of some complete pairs.

    Args:
        plan: the plan.
        found: the outcomes.
        preparation: {key of an arm: seconds that its synthetic scans took}.
        trainer: the name of the trainer.
        seen: what the generator was trained on.
    """
    places = sorted({place for place, _ in found})
    seeds = sorted({seed for _, seed in found})
    scores = {row: _scores(plan, found, row, places, seeds) for row in plan.rows}
    base = scores[plan.rows[0]]
    arms = [
        _arm(plan, found, row, scores, base, preparation.get(row.key, 0.0), places)
        for row in plan.rows
    ]
    for row in arms:
        budget = row["budget"].replace(GENERATOR_BUDGET, f"{GENERATOR_BUDGET}: {seen}")
        first, once, rest = budget.partition(CONSTANTS)
        row["budget"] = first + once + rest.replace(once, "")
    sizes = {
        name: {"scans": len(part), "tested": len(plan.tested[name])}
        for name, part in plan.places.items()
    }
    values: dict[str, Any] = {
        "labelled": plan.budget,
        "labelled_scans": {
            f"{place}, seed {seed}": [plan.names[i] for i in plan.labelled[place, seed]]
            for place, seed in found
        },
        "places": sizes,
        "left_out": plan.training is None,
        "tested_places": places,
        "seeds": len(seeds),
        "pairs": len(found),
        "planned_pairs": plan.wanted,
        "classes": [name for name in plan.groups if name not in plan.absent],
        "absent": plan.absent,
        "arms": arms,
        "trainer": trainer,
        "sensor": plan.sensor.name,
        "settings": plan.identity() | {"columns": plan.settings.columns},
        "iterations": plan.settings.iterations,
        "batch": plan.settings.batch,
        "precision": "bfloat16" if plan.half else "float32",
        "machine": machine(plan.device),
        "date": time.strftime("%Y-%m-%d"),
        "command": command_line(),
    }
    values["chosen_elsewhere"] = _chosen_elsewhere(plan, scores)
    values["over_best_real"] = _over_best_real(plan, scores)
    values["headline"] = headline(values)
    values["limits"] = limits(values)
    return Proof(values)


def _scores(
    plan: ProofPlan,
    found: Results,
    row: Row,
    places: Sequence[str],
    seeds: Sequence[int],
) -> Float64Array:
    """(P, S) mIoU in per cent; NaN where there is no training."""
    scores = np.full((len(places), len(seeds)), np.nan)
    for (place, seed), outcomes in found.items():
        value = 100 * mean_group_iou(outcomes[row].table, plan.groups)
        scores[places.index(place), seeds.index(seed)] = value
    return scores


def _mean(values: Float64Array) -> float:
    """The mean over places of the means over seeds."""
    return float(np.nanmean(np.nanmean(values, 1)))


def _interval(plan: ProofPlan, differences: Float64Array) -> tuple[float, float] | None:
    return interval(differences, shared=plan.training is not None)


def _arm(
    plan: ProofPlan,
    found: Results,
    row: Row,
    scores: Mapping[Row, Float64Array],
    base: Float64Array,
    preparation: float,
    places: Sequence[str],
) -> dict[str, Any]:
    """A row of the table, as plain values."""
    difference = scores[row] - base
    by_place = np.nanmean(difference, 1)
    scored = np.nanmean(scores[row], 1)
    judged = by_place[~np.isnan(by_place)]  # a place may have none of the classes
    outcomes = [outcomes[row] for outcomes in found.values()]
    first = row.name == BASE
    seconds = float(np.mean([outcome.seconds for outcome in outcomes]))
    return {
        "key": row.key,
        "arm": row.name,
        "ratio": row.ratio,
        "title": row.title,
        "synthetic": bool(row.arm.pools()),
        "miou": _mean(scores[row]),
        "difference": None if first else _mean(difference),
        "interval": None if first else _interval(plan, difference),
        "better_in": ""
        if first
        else f"{int((judged > 0).sum())} of {len(judged)} places",
        "by_place": dict(zip(places, map(_known, by_place), strict=True)),
        "miou_by_place": dict(zip(places, map(_known, scored), strict=True)),
        "iou": _class_ious(plan, outcomes),
        "curve": _curve(plan, outcomes),
        "loss": [o.losses for o in outcomes if o.losses][:1],
        "budget": _budget(plan, row),
        "minutes": (seconds + preparation) / 60,
        "training_seconds": seconds,
        "preparation_seconds": preparation,
        "iterations": round(plan.settings.iterations * row.arm.iterations),
    }


def _known(value: float) -> float | None:
    return None if np.isnan(value) else float(value)


def _budget(plan: ProofPlan, row: Row) -> str:
    real = any(stage.ratio < 1 for stage in row.stages())
    text = plan.budget if real else plan.budget.replace("labelled", "unlabelled")
    if not row.arm.budget:
        return text
    extra = row.arm.budget
    if any(pool == "skin" for pool in row.arm.pools()):
        learnt = [len(plan.skin_scans(place)) for place, _ in plan.pairs]
        extra = extra.replace(
            "scans of the training", f"{count_scans(learnt, 'scan')} of the training"
        )
    return f"{text}; {extra}"


def _class_ious(
    plan: ProofPlan, outcomes: Sequence[TrialOutcome]
) -> dict[str, float | None]:
    """IoU of every class in per cent, over the returns of all tested scans together."""
    total = np.sum([outcome.table for outcome in outcomes], 0)
    ious = 100 * group_ious(total, plan.groups)
    return {
        name: None if np.isnan(v) else float(v)
        for name, v in zip(plan.groups, ious, strict=True)
    }


def _curve(
    plan: ProofPlan, outcomes: Sequence[TrialOutcome]
) -> list[tuple[int, float]]:
    """(iterations, mean mIoU in per cent) during the training."""
    points: dict[int, list[float]] = {}
    for outcome in outcomes:
        for step, table in outcome.curve:
            points.setdefault(step, []).append(100 * mean_group_iou(table, plan.groups))
    return [
        (step, float(np.nanmean(values))) for step, values in sorted(points.items())
    ][:LOOKS]


def _chosen_elsewhere(
    plan: ProofPlan, scores: Mapping[Row, Float64Array]
) -> dict[str, Any] | None:
    """The gain in each place of the arm with synthetic scans that is best in the other places."""
    base = scores[plan.rows[0]]
    rows = [row for row in plan.rows if row.arm.pools()]
    if not rows or len(base) < 3:
        return None
    gains = np.stack([scores[row] - base for row in rows])
    means = np.nanmean(gains, 2)
    picked = [
        int(np.argmax(np.nanmean(np.delete(means, place, 1), 1)))
        for place in range(len(base))
    ]
    chosen = np.stack([gains[arm, place] for place, arm in enumerate(picked)])
    return {
        "difference": _mean(chosen),
        "interval": _interval(plan, chosen),
        "arms": [rows[i].key for i in picked],
    }


def _over_best_real(
    plan: ProofPlan, scores: Mapping[Row, Float64Array]
) -> dict[str, Any] | None:
    """The best arm with synthetic scans against the best arm with real scans only and as many
    iterations."""
    real = [row for row in plan.rows if not row.arm.pools() and row.arm.iterations == 1]
    synthetic = [row for row in plan.rows if row.arm.pools()]
    if not synthetic:
        return None
    best, other = (
        max(rows, key=lambda row: _mean(scores[row])) for rows in (synthetic, real)
    )
    difference = scores[best] - scores[other]
    return {
        "arm": best.key,
        "title": best.title,
        "real": other.title,
        "difference": _mean(difference),
        "interval": _interval(plan, difference),
    }


def headline(values: Mapping[str, Any]) -> str:
    """The result in a few sentences, of which each says what was compared with what."""
    arms = {row["key"]: row for row in values["arms"]}
    over = values["over_best_real"]
    base = arms[BASE]
    start = f"With {values['labelled']}"
    if over is None:
        return (
            f"{start}, real scans only reach {base['miou']:.1f} % mIoU; no arm with synthetic "
            "scans was trained."
        )
    best = arms[over["arm"]]
    ends = best["interval"]
    gain = best["difference"]
    change = f"{gain:+.1f} mIoU" + (f" {span(ends)}" if ends is not None else "")
    if ends is not None and ends[0] > 0:
        text = (
            f"{start}: {change} by “{best['title']}”, over {base['miou']:.1f} % with real scans "
            "only."
        )
    elif ends is None:
        text = (
            f"{start}, “{best['title']}” changes the mIoU by {change}, from {base['miou']:.1f} %; "
            f"an interval needs {FEWEST_PLACES} tested places, and there are "
            f"{len(values['tested_places'])}."
        )
    else:
        text = (
            f"{start}, no gain is shown: the best arm with synthetic scans, “{best['title']}”, "
            f"changes the mIoU by {change}, from {base['miou']:.1f} %."
        )
    if over["real"] != base["title"]:
        text += (
            f" Against “{over['real']}”: {format_signed(over['difference'])} "
            f"{span(over['interval'])}."
        )
    if "longer" in arms:
        longer = arms["longer"]
        gain = format_signed(longer["difference"])
        text += f" More iterations alone: {gain} {span(longer['interval'])}."
    swept = [
        row
        for row in values["arms"]
        if row["arm"] == best["arm"] and row["ratio"] is not None
    ]
    if len(swept) > 1:
        text += f" Best share of synthetic scans: {100 * best['ratio']:g} %."
    return text


def limits(values: Mapping[str, Any]) -> list[str]:
    """What the comparison does not show, in sentences."""
    found = []
    if values["pairs"] < values["planned_pairs"]:
        found.append(
            f"{values['pairs']} of {values['planned_pairs']} trainings per arm fitted into the "
            f"time: {len(values['tested_places'])} of {len(values['places'])} places were tested, "
            f"with {values['seeds']} seed{'s' * (values['seeds'] > 1)}. Run the same command with "
            "more --minutes to add the others."
        )
    if not values["left_out"]:
        found.append(
            "The training of a seed is tested in all places. An interval over "
            f"{values['seeds']} seed{'s' * (values['seeds'] > 1)} is too narrow if trainings "
            "differ as much as places; 5 seeds or more (--seeds) make it reliable."
        )
    if values["absent"]:
        found.append(
            f"Classes that no label of the scans used here has: {', '.join(values['absent'])}."
        )
    if values["chosen_elsewhere"] is not None:
        chosen = values["chosen_elsewhere"]
        found.append(
            "The best of several arms looks better than it is, because it was chosen on the "
            "places that it is measured on. Chosen on the other places each time: "
            f"{format_signed(chosen['difference'])} {span(chosen['interval'])}."
        )
    if values["trainer"] == "reference":
        found.append(
            f"The network is small and the training short ({values['iterations']} iterations of "
            f"{values['batch']} scans of {values['settings']['columns']} columns): a full training "
            "starts from a higher mIoU and may gain less. Test your own trainer with --trainer."
        )
    found.append(
        "Tested on single scans of this dataset only: another sensor, country or season was not "
        "tested."
    )
    return found
