"""Signs that the models are not to be trusted. Thresholds were set on the runs under results/ (docs/report.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from metrpo.checks.finding import Concern, after, horizons, iteration_at, losses_of, short, since_when
from metrpo.config import Config
from metrpo.counting import counted
from metrpo.run.metrics import Row, column

EXPLOITED = 0.5
"""Imagined above real return, in parts of the real one, mean over three iterations."""
AVERAGED, EARLY = 3, 5
"""Iterations of a running mean; and those in which models may promise too much."""
OUTLIER = 2.0
"""One model's validation loss over the median of the others'."""
RISING = 5.0
"""Validation loss, median of the models, over the lowest so far."""
DIVERGED = 0.01
"""Share of imagined rollouts that leave all bounds."""
BLIND = 1.0
"""Error of a prediction, in parts of that of predicting no change."""
LOST_ENDS, FALSE_ENDS, MISCALIBRATED = 0.5, 0.01, 0.05
"""Learned end of an episode: share of ends seen (least), share of other steps taken for one, calibration error."""


def model_exploited(rows: Sequence[Row], config: Config) -> Concern | None:
    """The models promise far more than the policy earns, at the end: early promises are what more data is for."""
    if config.imagine.disagreement:
        return None  # the promise holds the bonus for disagreement
    real, gap = column(rows, "return_real"), column(rows, "gap")
    gap = np.where(np.isfinite(gap), gap, np.nan)  # what is not finite has a warning of its own
    # Where returns pass through zero, half the way that the return has gone is the better measure.
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
        else f"{short(imagined)} where {short(earned)} is real"
    )
    members = "five models instead of one" if config.ensemble.members == 1 else "more models"
    early = len(rows) <= EARLY
    return Concern(
        "model-exploited",
        "note" if early else "warning",
        since,
        f"Imagined return {times} (mean of {AVERAGED} iterations)",
        "the policy exploits the models' errors" + (", as most do while data are few" if early else "") + _where(rows),
        f"{members} (ensemble.members), shorter imagined episodes (imagine.horizon) or more real steps help",
    )


def _where(rows: Sequence[Row]) -> str:
    """What else was measured of the last models, as the end of a sentence; nothing of a run from before that."""
    outside = column(rows, "outside")[-1]
    said = [f"{outside:.0%} of the imagined states lie outside the data"] if outside > 0 else []
    far = next((k for k in horizons(rows) if column(rows, f"error_{k}")[-1] > BLIND), None)
    said += [f"after {after(far)} predictions are worse than no change"] if far is not None else []
    return f" ({', and '.join(said)})" if said else ""


def models_blind(rows: Sequence[Row], config: Config) -> Concern | None:
    """Whoever predicts that nothing changes is nearer to the real next state than the models are."""
    error = column(rows, "error_1")
    since = since_when(rows, error > BLIND)
    if since is None or since > iteration_at(rows, -2):
        return None
    return Concern(
        "models-blind",
        "warning",
        since,
        f"Model error {short(error[-1])} times that of predicting no change, after a single step on held-out episodes",
        "the models know nothing of what an action does, so that the policy learns in a world of its own",
        "a look at the data first (do state, action and next state belong together? are there outliers?), then longer "
        "fitting (fit.max_passes, fit.patience) or a smaller fit.learning_rate",
    )


def unfit_dimensions(rows: Sequence[Row], config: Config) -> Concern | None:
    """Observations have an offset or a scale in which what a step changes is lost."""
    dimensions = column(rows, "unfit_dimensions")
    since = since_when(rows, dimensions > 0)
    if since is None:
        return None
    return Concern(
        "unfit-dimensions",
        "warning",
        since,
        f"{counted(int(dimensions[-1]), 'observed dimension')} of an offset or a scale that cannot be learned from",
        "float32, the bounds of imagination or the scales of policy and models hide how these change",
        "the first iteration of metrpo train names them and says what to do; give differences from something near, or "
        "another unit",
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
        "one model of the ensemble is badly fitted, and every imagined step may fall to it",
        "longer fitting (fit.patience, fit.max_passes), a smaller fit.learning_rate, or fresh weights more often "
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
        "the policy goes where the models know little, or fitting breaks off too soon",
        "longer fitting (fit.patience, fit.max_passes), larger models (ensemble.hidden), more collect.steps",
    )


def not_finite(rows: Sequence[Row], config: Config) -> Concern | None:
    """What should be a number is none."""
    names = [n for n in rows[0] if n.startswith("validation_loss_") or n in ("return_imagined", "train_loss", "kl")]
    # An empty cell is what a method does not measure.
    bad = [[n for n in names if row.get(n) is not None and not math.isfinite(row[n] or 0.0)] for row in rows]
    since = since_when(rows, np.array([bool(b) for b in bad]))
    if since is None:
        return None
    return Concern(
        "not-finite",
        "warning",
        since,
        f"{', '.join(bad[-1][:3])} {'is not a finite number' if len(bad[-1]) == 1 else 'are not finite numbers'}",
        "a model or the policy has left all bounds",
        "try a smaller fit.learning_rate, or rescale rewards and observations to about 1",
    )


def diverged(rows: Sequence[Row], config: Config) -> Concern | None:
    """Imagined rollouts leave all bounds."""
    share = column(rows, "diverged")
    since = since_when(rows, share > DIVERGED)
    if since is None:
        return None
    return Concern(
        "rollouts-diverge",
        "warning",
        since,
        f"{share[-1]:.1%} of the imagined rollouts diverge",
        "the models blow up on their own predictions, and the policy learns from what is left",
        "shorter imagined episodes (imagine.horizon), more models, a smaller collect.max_std",
    )


def end_untrusted(rows: Sequence[Row], config: Config) -> Concern | None:
    """The learned end of an episode is not where the real one is."""
    recall, alarms, error = (column(rows, f"end_{name}") for name in ("recall", "false_alarms", "error"))
    since = since_when(rows, (recall < LOST_ENDS) | (alarms > FALSE_ENDS) | (error > MISCALIBRATED))
    if since is None:
        return None
    said = [f"{recall[-1]:.0%} of the real ends seen"] if recall[-1] < LOST_ENDS else []
    said += [f"{alarms[-1]:.1%} of other steps taken for an end"] if alarms[-1] > FALSE_ENDS else []
    said += [f"calibration error {error[-1]:.1%}"] if error[-1] > MISCALIBRATED else []
    return Concern(
        "end-untrusted",
        "warning",
        since,
        f"Learned end of episodes on held-out steps: {', '.join(said)}",
        "imagined episodes end where real ones do not, or go on after them",
        "give the task its formula (terminated=), or collect more episodes that end",
    )


def _recent(values: np.ndarray, index: int) -> np.ndarray:
    return values[max(0, index - AVERAGED + 1) : index + 1]


def _ratio(above: np.ndarray, below: np.ndarray) -> float:
    total = float(np.sum(below))
    return float(np.sum(above)) / total if total > 0 else 0.0


def _finite(values: np.ndarray) -> np.ndarray:
    finite = values[np.isfinite(values)]
    return finite if len(finite) else np.zeros(1)
