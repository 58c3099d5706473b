"""Findings that the policy does not improve. Thresholds were set on the runs under results/ (docs/report.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from metrpo.checks.finding import Concern, iteration_at, short, since_when, standard_error
from metrpo.config import Config
from metrpo.counting import counted
from metrpo.run.metrics import Row, column

FELL = 0.25
"""Drop of the return below its best, as a fraction of its range, means over two iterations."""
COLLAPSED = 0.1
"""Standard deviation of the policy, as a fraction of the initial one."""
STILL = 0.02
"""KL divergence of an update, as a fraction of the trust region."""
REJECTED = 0.5
"""Share of the updates that moved nothing."""
SATURATED = 0.5
"""Share of the mean actions beyond the limits."""
SOON = 5
"""Early iterations, in which a policy may earn less than no skill."""
NEVER_ACCEPTED, NEVER_STOPPED, FLAT = 3, 8, 5
"""Iterations without an accepted update; that reach max_updates; without a first gain."""
LAST, FEW = 10, 5
"""How many of the last iterations to look at, and how many of them may lack an accepted update."""


def return_fell(rows: Sequence[Row], config: Config) -> Concern | None:
    """The policy was better once, by more than the episodes' spread explains."""
    real, error = column(rows, "return_real"), standard_error(rows, config)
    if len(real) < 4 or not np.isfinite(real).all():
        return None
    pairs = (real[1:] + real[:-1]) / 2
    best = int(np.argmax(pairs))
    way, fall = pairs[best] - real.min(), pairs[best] - pairs[-1]
    if fall <= FELL * way or fall <= 3 * max(error[-1], error[best]):
        return None
    low = pairs[best] - FELL * way
    after = f"after {short(pairs[best])} around iteration {int(iteration_at(rows, best))} (means of two)"
    models = "its models no longer tell better from worse where it goes" if "gap" in rows[0] else "see its video"
    since = since_when(rows, np.append(False, (np.arange(len(pairs)) > best) & (pairs < low))) or int(
        iteration_at(rows, -1)
    )
    size = "gradient.learning_rate" if config.by_critics else "trpo.max_kl"
    return Concern(
        "return-fell",
        "warning",
        since,
        f"Return {short(pairs[-1])}, {after}",
        f"the policy has unlearned ({models})",
        "use the policy in the run's folder best/, or try more models (ensemble.members), "
        f"smaller steps ({size}), more real steps",
    )


def not_evaluated(rows: Sequence[Row], config: Config) -> Concern | None:
    """The evaluation fails. (A task without an environment rightly has none.)"""
    real, failed = column(rows, "return_real"), column(rows, "failed_evaluation")
    since = since_when(rows, ~np.isfinite(real))
    # Rows from before that column do not say why there is no return.
    has_environment = np.isfinite(real).any() or (failed == 1).any() or config.method != "model-based"
    if since is None or not has_environment:
        return None
    return Concern(
        "not-evaluated",
        "warning",
        since,
        "No real return",
        "the environment failed in the policy's evaluation, or gave rewards that are not finite; learning continues",
        "run metrpo evaluate DIR to see where; end an episode before the simulation diverges",
    )


def failed_episodes(rows: Sequence[Row], config: Config) -> Concern | None:
    """The environment fails in some episodes, which are left out of learning."""
    failed = column(rows, "failed_episodes")
    if not np.nansum(failed):
        return None
    first = int(np.flatnonzero(np.nan_to_num(failed))[0])
    return Concern(
        "failed-episodes",
        "note",
        int(iteration_at(rows, first)),
        f"{int(np.nansum(failed))} real episodes left out",
        "the environment failed in them (NaN, infinity, an exception), so nothing is learned about where it fails",
        "end an episode before the simulation diverges, or repair the environment",
    )


def no_improvement(rows: Sequence[Row], config: Config, yardsticks: Mapping[str, float]) -> Concern | None:
    """No iteration is better than the first: a remark only, where that one was clearly better than no skill."""
    real, error = column(rows, "return_real"), standard_error(rows, config)
    if len(real) < FLAT or not np.isfinite(real).all() or real[1:].max() > real[0] + 2 * error[0]:
        return None
    noise = "actor_critic.entropy_target" if config.by_critics else "collect.max_std"
    skilled = bool(yardsticks) and real[0] > max(yardsticks.values()) + 2 * error[0]
    return Concern(
        "no-improvement",
        "note" if skilled else "warning",
        int(iteration_at(rows, 0)),
        f"No return above the first one, {short(real[0])}, in {counted(len(real), 'iteration')}",
        "the task was solved at once, or nothing is learned",
        f"watch the video; if the policy fails, explore more ({noise}), collect more real steps an iteration "
        "(collect.steps), or give a more informative reward",
    )


def no_skill(rows: Sequence[Row], config: Config, yardsticks: Mapping[str, float]) -> Concern | None:
    """The policy earns no more than one without skill."""
    real = column(rows, "return_real")
    if not yardsticks or not np.isfinite(real[-1]):
        return None
    name, best = max(yardsticks.items(), key=lambda item: item[1])
    since = since_when(rows, real <= best)
    if since is None:
        return None
    return Concern(
        "no-skill",
        "note" if len(rows) < SOON else "warning",
        since,
        f"Return {short(real[-1])}, while {name} earns {short(best)}",
        "the policy is no better than none",
        "look at its video and at the gap; try more real steps, another seed, or a more informative reward",
    )


def few_episodes(rows: Sequence[Row], config: Config) -> Concern | None:
    """The error of the return is larger than its change."""
    real, error = column(rows, "return_real"), standard_error(rows, config)
    if len(real) < 3 or not np.isfinite(real).all():
        return None
    typical, progress = float(np.median(error)), float(real.max() - real[0])
    # A policy that never varies has no error; of one episode, the error is unknown.
    known = config.evaluation_episodes > 1
    if known and (typical == 0 or typical <= progress):
        return None
    measured = (
        f"Standard error of the return {short(typical)}, gain so far {short(progress)}"
        if known
        else "One real episode per evaluation"
    )
    return Concern(
        "few-evaluation-episodes",
        "note",
        int(iteration_at(rows, 0)),
        measured,
        "the noise hides whether the policy improves",
        f"evaluate on more episodes than {config.evaluation_episodes} (evaluation_episodes; they cost no real steps of "
        "the budget), or run metrpo evaluate --episodes 100",
    )


def std_collapsed(rows: Sequence[Row], config: Config) -> Concern | None:
    """The policy hardly explores any more."""
    if config.method == "ddpg" or config.by_critics:
        return None  # the noise of one is not the policy's, that of the other steered by its entropy
    std = column(rows, "mean_std")
    since = since_when(rows, std < COLLAPSED * config.policy.initial_std)
    if since is None:
        return None
    return Concern(
        "std-collapsed",
        "warning" if config.method == "model-based" else "note",  # only there does it start anew in every iteration
        since,
        f"Standard deviation of the policy {short(std[-1])}, at first {short(config.policy.initial_std)}",
        "the policy hardly explores, so its gradient says little",
        "make fewer updates an iteration (validate.max_updates), lower trpo.max_kl, raise policy.initial_std",
    )


def saturated(rows: Sequence[Row], config: Config) -> Concern | None:
    """Most mean actions lie beyond the limits; clipped, they have no gradient."""
    share = column(rows, "saturated")
    since = since_when(rows, share > SATURATED)
    if since is None:
        return None
    measured, meaning, advice = (
        (
            f"{share[-1]:.0%} of the policy's mean actions beyond 0.99",
            "the tanh is flat there: the policy may be stuck in a local optimum",
            "raise actor_critic.entropy_target, or lower gradient.learning_rate",
        )
        if config.by_critics
        else (
            f"{share[-1]:.0%} of the policy's mean actions beyond the limits",
            "clipped actions have no gradient: the policy may be stuck in a local optimum",
            "set policy.normalise, raise policy.mean_penalty, raise policy.initial_std",
        )
    )
    return Concern("policy-saturated", "warning", since, measured, meaning, advice)


def updates_rejected(rows: Sequence[Row], config: Config) -> Concern | None:
    """The optimiser hardly moves the policy, or not at all."""
    updates, rejected, kl = (column(rows, name) for name in ("updates", "rejected_steps", "kl"))
    share = rejected / np.fmax(updates, 1)
    trust = config.trpo.max_kl if "trpo" in (config.method, config.improver) else 0.0
    still = (kl < STILL * trust) | ((kl == 0) & (updates > 0))
    since = since_when(rows, (share > REJECTED) | still)
    if since is None:
        return None
    measured = f"{share[-1]:.0%} of the updates rejected" if share[-1] > REJECTED else f"Updates of KL {short(kl[-1])}"
    advice = (
        "lower gradient.learning_rate and actor_critic.critic_learning_rate, or give a reward that varies"
        if config.by_critics
        else "use more imagined steps an update (imagine.steps), more trpo.damping, or a reward that varies"
    )
    return Concern(
        "updates-rejected",
        "warning",
        since,
        measured,
        "the policy does not move: its gradient is noise, zero or not finite",
        advice,
    )


def nothing_accepted(rows: Sequence[Row], config: Config) -> Concern | None:
    """The models do not agree on any better policy."""
    nothing = column(rows, "accepted_updates") == 0
    since = since_when(rows, nothing)
    if since is not None and (count := int(iteration_at(rows, -1)) - since + 1) >= NEVER_ACCEPTED:
        measured = f"No policy update accepted in {counted(count, 'iteration')}"
    elif len(nothing) >= LAST and (count := int(nothing[-LAST:].sum())) >= FEW:
        since, measured = int(iteration_at(rows, -LAST)), f"No policy update accepted in {count} of {LAST} iterations"
    else:
        return None
    patience = "" if config.by_critics else ", a longer validate.patience"
    return Concern(
        "nothing-accepted",
        "note",
        since,
        measured,
        "the policy stays the same: the models see no improvement, or do not agree on one",
        f"if the return is good, the run has converged; if not, try more real steps{patience} or a lower "
        "validate.threshold",
    )


def never_stopped(rows: Sequence[Row], config: Config) -> Concern | None:
    """Validation never stops the policy, so nothing guards it against the models' errors."""
    if config.method != "model-based" or config.by_critics or config.validate.rule == "no_early":
        return None  # the critics' vote stops nothing
    since = since_when(rows, column(rows, "updates") >= config.validate.max_updates)
    if since is None or (count := int(iteration_at(rows, -1)) - since + 1) < NEVER_STOPPED:
        return None
    judge = "the one model judges itself and" if config.ensemble.members == 1 else "the models"
    cure = "use five models (ensemble.members)" if config.ensemble.members == 1 else "raise validate.max_updates"
    return Concern(
        "validation-never-stops",
        "warning" if config.ensemble.members == 1 else "note",
        since,
        f"All {counted(config.validate.max_updates, 'policy update')} made in each of {counted(count, 'iteration')}",
        f"{judge} never stop{'s' if config.ensemble.members == 1 else ''} the policy",
        f"{cure}; an imagined return far above the real one says that the stop is needed",
    )
