"""Findings that the models cannot be trusted. Thresholds were set on the runs under results/ (docs/report.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from metrpo.checks.finding import Concern, after, horizons, iteration_at, losses_of, short, since_when
from metrpo.config import Config
from metrpo.counting import counted
from metrpo.run.metrics import Row, column

EXPLOITED = 0.5
"""Excess of the imagined over the real return, as a fraction of the real one, mean over three iterations."""
AVERAGED, EARLY = 3, 5
"""Iterations of a running mean; and early iterations, in which models may promise too much."""
OUTLIER = 2.0
"""One model's validation loss divided by the median of the others'."""
RISING = 5.0
"""Validation loss (median of the models) divided by the lowest so far."""
DIVERGED = 0.01
"""Share of imagined rollouts that diverge."""
BLIND = 1.0
"""Error of a prediction divided by that of predicting no change."""
LOST_ENDS, FALSE_ENDS, MISCALIBRATED = 0.5, 0.01, 0.05
"""Learned end of an episode: least recall, and most false alarms and calibration error."""


def model_exploited(rows: Sequence[Row], config: Config) -> Concern | None:
    """The models still promise far more than the policy earns. (More data cures early promises.)"""
    if config.imagine.disagreement:
        return None  # the imagined return includes the bonus for disagreement
    real, gap = column(rows, "return_real"), column(rows, "gap")
    gap = np.where(np.isfinite(gap), gap, np.nan)  # what is not finite has a warning of its own
    # Where returns pass through zero, half of their range is the better measure.
    way = np.array([np.ptp(_finite(real[: i + 1])) for i in range(len(real))])
    scale = np.fmax(np.fmax(np.abs(real), way / 2), column(rows, "return_real_std"))
    above = np.array([_ratio(_recent(gap, i), _recent(scale, i)) for i in range(len(rows))])
    since = since_when(rows, above > EXPLOITED)
    if since is None or len(rows) < AVERAGED:
        return None
    imagined, earned = (float(np.mean(_recent(x, len(rows) - 1))) for x in (real + gap, real))
    times = (
        f"{imagined / earned:.1f} times the real one"
        if earned > 0
        else f"{short(imagined)}, real return {short(earned)}"
    )
    members = "five models instead of one" if config.ensemble.members == 1 else "more models"
    shorter = "less trust (actor_critic.trust)" if config.by_critics else "shorter imagined episodes (imagine.horizon)"
    early = len(rows) <= EARLY
    return Concern(
        "model-exploited",
        "note" if early else "warning",
        since,
        f"Imagined return {times} (mean of {AVERAGED} iterations)",
        "the policy exploits the models' errors" + (", as most do on little data" if early else "") + _where(rows),
        f"try {members} (ensemble.members), {shorter} or more real steps",
    )


def _where(rows: Sequence[Row]) -> str:
    """Other measurements of the last models, as the end of a sentence; empty for runs from before these."""
    outside = column(rows, "outside")[-1]
    parts = [f"{outside:.0%} of the imagined states lie outside the data"] if outside > 0 else []
    far = next((k for k in horizons(rows) if column(rows, f"error_{k}")[-1] > BLIND), None)
    parts += [f"after {after(far)} predictions are worse than no change"] if far is not None else []
    return f" ({', and '.join(parts)})" if parts else ""


def models_blind(rows: Sequence[Row], config: Config) -> Concern | None:
    """Predicting no change comes nearer to the real next state than the models do."""
    error = column(rows, "error_1")
    since = since_when(rows, error > BLIND)
    if since is None or since > iteration_at(rows, -2):
        return None
    return Concern(
        "models-blind",
        "warning",
        since,
        f"Model error {short(error[-1])} times that of predicting no change, after a single step on held-out episodes",
        "the models do not know what an action does, so the policy learns in a world of its own",
        "check the data first (do state, action and next state belong together? are there outliers?), then fit longer "
        f"({_limits(config)}) or lower fit.learning_rate",
    )


def _limits(config: Config) -> str:
    """The settings that end a fit."""
    steps = ["fit.max_steps"] if config.fit.max_steps is not None else []
    return ", ".join([*steps, *([] if config.fit.decay else ["fit.patience", "fit.max_passes"])])


def unfit_dimensions(rows: Sequence[Row], config: Config) -> Concern | None:
    """Some observations have an offset or a scale that hides the change of one step."""
    dimensions = column(rows, "unfit_dimensions")
    since = since_when(rows, dimensions > 0)
    if since is None:
        return None
    return Concern(
        "unfit-dimensions",
        "warning",
        since,
        f"{counted(int(dimensions[-1]), 'observed dimension')} with an offset or a scale that cannot be learned from",
        "float32, the bounds of imagination or the scales of policy and models hide how these change",
        "observe differences from something near, or change the unit; the first iteration of metrpo train names the "
        "dimensions and the cure",
    )


def member_apart(rows: Sequence[Row], config: Config) -> Concern | None:
    """One model is far worse than the others on held-out data."""
    losses = losses_of(rows)
    if losses.shape[1] < 3:
        return None
    others = np.array([np.median(np.delete(losses, k, axis=1), axis=1) for k in range(losses.shape[1])]).T
    ratio = losses / np.maximum(others, np.finfo(float).tiny)
    since = since_when(rows, ratio.max(axis=1) > OUTLIER)
    if since is None or since > iteration_at(rows, -2):
        return None
    k = int(np.argmax(ratio[-1]))
    return Concern(
        "member-apart",
        "warning",
        since,
        f"Validation loss of model {k} is {short(losses[-1, k])}, {ratio[-1, k]:.1f} times the others' median",
        "one model of the ensemble is badly fitted, and any imagined step may use it",
        f"fit longer ({_limits(config)}), lower fit.learning_rate, or start from fresh weights more often "
        "(fit.reinitialise_every)",
    )


def loss_rises(rows: Sequence[Row], config: Config) -> Concern | None:
    """The models have become much worse at what the policy now does."""
    losses = losses_of(rows)
    if not losses.size or len(rows) < AVERAGED:
        return None
    middle = np.median(losses, axis=1)
    times = middle / np.maximum(np.minimum.accumulate(middle), np.finfo(float).tiny)
    since = since_when(rows, times > RISING)
    if since is None or since > iteration_at(rows, -2):
        return None
    return Concern(
        "validation-loss-rising",
        "note",
        since,
        f"Validation loss {short(middle[-1])}, {times[-1]:.1f} times its lowest",
        "the policy visits states that the models know little about, or fitting stops too soon",
        f"fit longer ({_limits(config)}), use larger models (ensemble.hidden), raise collect.steps",
    )


def not_finite(rows: Sequence[Row], config: Config) -> Concern | None:
    """A loss, a return or a KL divergence is not finite."""
    names = [n for n in rows[0] if n.startswith("validation_loss_") or n in ("return_imagined", "train_loss", "kl")]
    # A cell is empty where a method does not measure it.
    bad = [[n for n in names if row.get(n) is not None and not math.isfinite(row[n] or 0.0)] for row in rows]
    since = since_when(rows, np.array([bool(b) for b in bad]))
    if since is None:
        return None
    return Concern(
        "not-finite",
        "warning",
        since,
        f"{', '.join(bad[-1][:3])} {'is not a finite number' if len(bad[-1]) == 1 else 'are not finite numbers'}",
        "a model or the policy has diverged",
        "lower fit.learning_rate, or rescale rewards and observations to about 1",
    )


def diverged(rows: Sequence[Row], config: Config) -> Concern | None:
    """Imagined rollouts diverge."""
    share = column(rows, "diverged")
    since = since_when(rows, share > DIVERGED)
    if since is None:
        return None
    shorter, noise = (
        ("actor_critic.horizon", "actor_critic.entropy_target")
        if config.by_critics
        else ("imagine.horizon", "collect.max_std")
    )
    return Concern(
        "rollouts-diverge",
        "warning",
        since,
        f"{share[-1]:.1%} of the imagined rollouts diverge",
        "the models blow up on their own predictions, and the policy learns from the rest",
        f"shorten imagined episodes ({shorter}), add models (ensemble.members), lower {noise}",
    )


def end_untrusted(rows: Sequence[Row], config: Config) -> Concern | None:
    """Learned ends of episodes differ from real ones."""
    recall, alarms, error = (column(rows, f"end_{name}") for name in ("recall", "false_alarms", "error"))
    since = since_when(rows, (recall < LOST_ENDS) | (alarms > FALSE_ENDS) | (error > MISCALIBRATED))
    if since is None:
        return None
    parts = [f"{recall[-1]:.0%} of the real ends predicted"] if recall[-1] < LOST_ENDS else []
    parts += [f"{alarms[-1]:.1%} of other steps mistaken for an end"] if alarms[-1] > FALSE_ENDS else []
    parts += [f"calibration error {error[-1]:.1%}"] if error[-1] > MISCALIBRATED else []
    return Concern(
        "end-untrusted",
        "warning",
        since,
        f"Learned end of episodes on held-out steps: {', '.join(parts)}",
        "imagined episodes end earlier or later than real ones",
        "give the task a formula (terminated=), or collect more episodes that end",
    )


def _recent(values: np.ndarray, index: int) -> np.ndarray:
    return values[max(0, index - AVERAGED + 1) : index + 1]


def _ratio(above: np.ndarray, below: np.ndarray) -> float:
    total = float(np.sum(below))
    return float(np.sum(above)) / total if total > 0 else 0.0


def _finite(values: np.ndarray) -> np.ndarray:
    finite = values[np.isfinite(values)]
    return finite if len(finite) else np.zeros(1)
