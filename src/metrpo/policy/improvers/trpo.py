"""Trust-region policy optimization (Schulman et al. 2015): natural gradient by conjugate gradients, line search."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float, Int

from metrpo.config import TRPOConfig
from metrpo.devices import across
from metrpo.policy import gaussian
from metrpo.policy.gaussian import Policy
from metrpo.policy.improvers.batch import Batch, ImproveInfo
from metrpo.policy.improvers.linearised import Linearised, chunked, forward, gauss_newton, linearise, pull_back
from metrpo.types import Array

_Attempt = tuple[Bool[Array, ""], Float[Array, ""], Float[Array, ""]]
"""Of a step: whether it is accepted, the surrogate and the KL divergence."""


def improve(policy: Policy, batch: Batch, config: TRPOConfig, penalty: float = 0.0) -> tuple[Policy, ImproveInfo]:
    """One TRPO update on `batch`; the policy stays as it is when no step of the line search improves within max_kl.

    The surrogate loses `penalty` times what saturated mean actions cost (`gaussian.saturation`): clipped actions have
    no gradient that could bring them back.
    """
    states, actions, advantages, mask = (chunked(x) for x in batch)
    count = jnp.maximum(across(jnp.sum(mask)), 1.0)
    weights = mask * advantages / count
    old_log_std = policy.log_std[:, None]
    at = linearise(policy.layers, states)

    def cost(means: Float[Array, "*steps A n"], mask: Float[Array, "*steps 1 n"]) -> Float[Array, ""]:
        return penalty / count * jnp.sum(mask * gaussian.saturation(means, old_log_std)) if penalty else jnp.float32(0)

    def surrogate_and_kl(new: Policy) -> tuple[Float[Array, ""], Float[Array, ""]]:
        log_std = new.log_std[:, None]

        def add(
            total: tuple[Float[Array, ""], Float[Array, ""]], chunk: tuple[Float[Array, "_ n"], ...]
        ) -> tuple[tuple[Float[Array, ""], Float[Array, ""]], None]:
            states, actions, old_means, weights, mask = chunk
            means = forward(new.layers, states)[-1]
            log_ratio = gaussian.log_probability(means, log_std, actions, 0) - gaussian.log_probability(
                old_means, old_log_std, actions, 0
            )
            divergence = gaussian.kl(old_means, old_log_std, means, log_std, 0)
            gain = jnp.sum(weights * jnp.exp(log_ratio)) - cost(means, mask)
            return (total[0] + gain, total[1] + jnp.sum(mask * divergence)), None

        zero = (jnp.float32(0), jnp.float32(0))
        surrogate, divergence = across(jax.lax.scan(add, zero, (states, actions, at.means, weights, mask))[0])
        return surrogate, divergence / count

    # The surrogate's gradient at the old policy, where every ratio is 1.
    z = (actions - at.means) * jnp.exp(-old_log_std)
    rising = weights * z * jnp.exp(-old_log_std)
    if penalty:
        rising = rising - 2 * penalty / count * mask * gaussian.excess(at.means) * jnp.exp(-old_log_std)
    slope = Policy(pull_back(at, rising), jnp.sum(weights * (jnp.square(z) - 1.0), axis=(0, 2)))
    flat, unravel = ravel_pytree(policy)
    gradient = ravel_pytree(across(slope))[0]
    if (every := config.fisher_every) > 1:
        at_sample, sampled = linearise(policy.layers, chunked(batch.states[::every])), chunked(batch.mask[::every])
    else:
        at_sample, sampled = at, mask
    product = fisher_product(policy, at_sample, sampled, config.damping)
    direction, residual = conjugate_gradient(
        lambda v: ravel_pytree(product(unravel(v)))[0], gradient, config.cg_iterations
    )
    # F x = g - residual, so x'Fx needs no further product.
    curvature = jnp.dot(direction, gradient - residual)
    step = direction * jnp.sqrt(2 * config.max_kl / jnp.maximum(curvature, 1e-12))
    start = across(jnp.sum(weights) - cost(at.means, mask))

    def attempt(i: Int[Array, ""]) -> _Attempt:
        candidate = flat + config.backtrack_ratio**i * step
        surrogate, divergence = surrogate_and_kl(unravel(candidate))
        # Comparisons with NaN are false: a step into NaN is never accepted.
        return (surrogate > start) & (surrogate < jnp.inf) & (divergence <= config.max_kl), surrogate, divergence

    def searching(carry: tuple[Int[Array, ""], _Attempt]) -> Bool[Array, ""]:
        return ~carry[1][0] & (carry[0] < config.max_backtracks - 1)

    def search(carry: tuple[Int[Array, ""], _Attempt]) -> tuple[Int[Array, ""], _Attempt]:
        return carry[0] + 1, attempt(carry[0] + 1)

    zero = jnp.int32(0)
    tries, (accepted, surrogate, divergence) = jax.lax.while_loop(searching, search, (zero, attempt(zero)))
    new = jnp.where(accepted, flat + config.backtrack_ratio**tries * step, flat)
    norm = jnp.linalg.norm(gradient)
    return unravel(new), ImproveInfo(
        kl=jnp.where(accepted, divergence, 0.0),
        improvement=jnp.where(accepted, surrogate - start, 0.0),
        accepted=accepted,
        backtracks=tries,
        cg_residual=jnp.linalg.norm(residual) / jnp.maximum(norm, 1e-30),
    )


def fisher_product(
    policy: Policy, at: Linearised, mask: Float[Array, "C 1 n"], damping: float
) -> Callable[[Policy], Policy]:
    """v -> (F + damping I) v, F the policy's Fisher matrix averaged over the steps where `mask` is 1.

    The Gaussian's Fisher matrix is J' diag(1 / std^2) J for the mean network and 2 I for log_std (Gauss-Newton), which
    is the Hessian of KL(old || new) at new = old.
    """
    count = jnp.maximum(across(jnp.sum(mask)), 1.0)
    weights = mask * jnp.exp(-2 * policy.log_std)[:, None] / count

    def product(v: Policy) -> Policy:
        curvature = Policy(across(gauss_newton(at, weights, v.layers)), 2.0 * v.log_std)
        return jax.tree.map(lambda c, x: c + damping * x, curvature, v)

    return product


_Solving = tuple[Float[Array, "p"], Float[Array, "p"], Float[Array, "p"], Float[Array, ""]]
"""x, its residual, the next direction and the residual's square."""


def conjugate_gradient(
    product: Callable[[Float[Array, "p"]], Float[Array, "p"]], target: Float[Array, "p"], iterations: int
) -> tuple[Float[Array, "p"], Float[Array, "p"]]:
    """Solves product(x) = target from x = 0: (x, residual target - product(x))."""

    def step(_: Int[Array, ""], carry: _Solving) -> _Solving:
        x, residual, direction, square = carry
        image = product(direction)
        # Once solved, direction and residual are 0: the guards keep 0 / 0 out.
        alpha = square / jnp.maximum(jnp.dot(direction, image), 1e-30)
        x, residual = x + alpha * direction, residual - alpha * image
        next_square = jnp.dot(residual, residual)
        return x, residual, residual + next_square / jnp.maximum(square, 1e-30) * direction, next_square

    start = (jnp.zeros_like(target), target, target, jnp.dot(target, target))
    x, residual, _, _ = jax.lax.fori_loop(0, iterations, step, start)
    return x, residual
