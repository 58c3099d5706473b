"""PPO (Schulman et al. 2017) and DDPG (Lillicrap et al. 2016) of Stable-Baselines3 in the real environment.

Every iteration builds Stable-Baselines3's objects anew from the state and the iteration's seed and starts with a fresh
episode, so that a resumed run is the same run. They are made what OpenAI baselines' are
(`metrpo.baselines.openai_defaults`). The exported policy takes raw states: the statistics by which observations are
standardised go into its first layer. Needs the extra `baselines`; importing this without it raises `MetrpoError`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from typing import Any, NamedTuple

import numpy as np
from gymnasium.spaces import Box
from gymnasium.wrappers import TransformObservation

from metrpo import budget
from metrpo.config import Config
from metrpo.console.progress import SILENT, Progress
from metrpo.errors import MetrpoError
from metrpo.policy.gaussian import Policy
from metrpo.run.clock import Clock
from metrpo.run.metrics import Row
from metrpo.seeds import Stage, rng_of
from metrpo.stages.records import recorded_returns
from metrpo.world.env_returns import closing
from metrpo.world.task import Task

try:
    import torch
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.logger import Logger
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.noise import NormalActionNoise

    from metrpo.baselines import openai_defaults as defaults
    from metrpo.baselines.openai_defaults import (
        ClockEnds,
        NormedDDPG,
        NormedPPO,
        NormedTD3Policy,
        Standardised,
        Statistics,
    )
except ImportError as error:
    raise MetrpoError(
        f"the systems ppo and ddpg need PyTorch and Stable-Baselines3 ({error}): run `make baselines`, or "
        "`pip install torch==2.13.0` and then `pip install 'metrpo[baselines]'`"
    ) from error


class SB3State(NamedTuple):
    """Everything that an iteration hands to the next: a pytree of NumPy arrays whose structure the config fixes."""

    iteration: int
    """Outer iterations finished."""
    real_steps: int
    """Real steps collected so far."""
    policy: Policy
    """The actor: both give the same deterministic actions."""
    parameters: dict[str, np.ndarray]
    """Of all networks, by PyTorch's names."""
    adam: tuple[tuple[tuple[np.ndarray, ...], ...], ...]
    """Of every optimiser, of every parameter: the entries `_ADAM` of its memory."""
    statistics: dict[str, np.ndarray]
    """Sums over the observations learned from, float64."""
    replay: dict[str, np.ndarray]
    """DDPG's n transitions, the oldest first: `_REPLAY`, float32, [n, S] twice, [n, A], [n] twice. Empty for PPO."""


def init(config: Config, task: Task) -> SB3State:
    """The state before the first iteration."""
    with closing(training_env(task), task.name) as env:
        return state_of(config, new_model(config, env, _seed(config, 0, Stage.INIT), None), 0)


def step(config: Config, task: Task, state: SB3State, progress: Progress = SILENT) -> tuple[SB3State, Row]:
    """One outer iteration: learning for `collect.steps` real steps, or what is left of the budget, in whole updates."""
    iteration, clock = state.iteration + 1, Clock()
    with closing(training_env(task), task.name) as env, clock("improve"):
        wanted = budget.steps_wanted(config, state.real_steps)
        progress.stage("learn", wanted)
        model = new_model(config, env, _seed(config, iteration, Stage.COLLECT), state)
        watch = _Watch(state.real_steps, clock, progress)
        model.learn(wanted, watch, log_interval=None, reset_num_timesteps=False)
        collected = env.get_episode_rewards()
        state = state_of(config, model, iteration)
    with clock("evaluate"):
        progress.stage("evaluate", config.evaluation_episodes)
        returns = recorded_returns(config, task, state.policy, iteration)
    return state, {
        "iteration": state.iteration,
        "real_steps": state.real_steps,
        "return_real": float(np.mean(returns)),
        "return_real_std": float(np.std(returns)),
        "return_collected": float(np.mean(collected)) if collected else math.nan,
        "mean_std": float(np.mean(np.exp(state.policy.log_std))),
        **clock.row(),
    }


class _Watch(BaseCallback):
    """Counts rollouts as the stage "collect", and tells the progress after each."""

    def __init__(self, steps_before: int, clock: Clock, progress: Progress) -> None:
        super().__init__()
        self._steps_before, self._clock, self._progress = steps_before, clock, progress
        self._collecting = ExitStack()

    def _on_rollout_start(self) -> None:
        self._collecting.enter_context(self._clock("collect"))

    def _on_step(self) -> bool:
        if isinstance(self.model, NormedDDPG):  # PPO's batch may not change while it is drawn
            self.model.actor.features_extractor._statistics.update(self.model._last_obs)
        return True

    def _on_rollout_end(self) -> None:
        self._collecting.close()
        self._progress.update(self.num_timesteps - self._steps_before)


def training_env(task: Task) -> Monitor:
    """The environment as Stable-Baselines3 plays it, with a record of its episodes."""
    # float32 halves the replay buffer, and is what the networks compute in.
    space = Box(-np.inf, np.inf, (task.state_size,), np.float32)
    return Monitor(ClockEnds(TransformObservation(task.make_env(), lambda state: state.astype(np.float32), space)))


def _seed(config: Config, iteration: int, stage: Stage) -> int:
    return int(rng_of(config.seed, iteration, stage).integers(2**31))


# ---------------------------------------------------------------- the two algorithms


def _ppo(config: Config, env: Monitor, seed: int, _: SB3State | None) -> NormedPPO:
    hidden, settings = list(config.policy.hidden), defaults.PPO_SETTINGS | {"gamma": config.advantage.discount}
    networks: dict[str, Any] = {"net_arch": {"pi": hidden, "vf": hidden}, "activation_fn": torch.nn.Tanh}
    networks |= {"log_std_init": math.log(config.policy.initial_std), **_standardised(env)}
    batch = settings["batch_size"]
    steps = min(defaults.PPO_STEPS, batch * math.ceil(config.collect.steps / batch))
    return NormedPPO("MlpPolicy", env, n_steps=steps, policy_kwargs=networks, seed=seed, device="cpu", **settings)


def _ppo_policy(model: Any) -> Policy:
    mean = [*model.policy.mlp_extractor.policy_net, model.policy.action_net]
    return Policy(_raw(model, _layers(mean)), _numpy(model.policy.log_std))


def _ddpg(config: Config, env: Monitor, seed: int, state: SB3State | None) -> NormedDDPG:
    steps, kept = config.collect.steps, len(state.replay["rewards"]) if state else 0
    action = np.zeros(env.action_space.shape)
    sizes = {"pi": list(config.policy.hidden), "qf": list(defaults.DDPG_CRITIC)}
    return NormedDDPG(
        NormedTD3Policy,
        env,
        gamma=config.advantage.discount,
        # Room for this iteration, rounded up: the next one has a buffer of its own.
        buffer_size=min(defaults.DDPG_BUFFER, kept + steps + defaults.DDPG_STEPS),
        learning_starts=min(defaults.DDPG_WARM_UP, steps // 2),
        train_freq=min(defaults.DDPG_STEPS, steps),
        action_noise=NormalActionNoise(action, action + defaults.DDPG_NOISE),
        policy_kwargs={"net_arch": sizes, "activation_fn": torch.nn.Tanh, **_standardised(env)},
        seed=seed,
        device="cpu",
        **defaults.DDPG_SETTINGS,
    )


def _ddpg_policy(model: Any) -> Policy:
    # The actor's output goes through tanh, as only hidden layers do in a policy: an identity after it makes it one.
    layers = _raw(model, _layers(model.actor.mu))
    identity = np.eye(len(layers[-1][1]), dtype=np.float32)
    log_std = np.full(len(identity), math.log(defaults.DDPG_NOISE), np.float32)
    return Policy((*layers, (identity, 0 * identity[0])), log_std)


def _standardised(env: Monitor) -> dict[str, Any]:
    """What makes all networks of an algorithm see observations by the same statistics."""
    statistics = Statistics(env.observation_space.shape[0])
    return {"features_extractor_class": Standardised, "features_extractor_kwargs": {"statistics": statistics}}


def _statistics(model: Any) -> Statistics:
    statistics: Statistics = model.policy_kwargs["features_extractor_kwargs"]["statistics"]
    return statistics


def _raw(model: Any, layers: tuple[tuple[np.ndarray, np.ndarray], ...]) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """The layers of a network for raw observations."""
    return (_statistics(model).folded(*layers[0]), *layers[1:])


def _layers(modules: Iterable[Any]) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    return tuple((_numpy(m.weight.T), _numpy(m.bias)) for m in modules if isinstance(m, torch.nn.Linear))


_Table = dict[str, tuple[Callable[..., Any], Callable[[Any], Policy]]]
_METHODS: _Table = {"ppo": (_ppo, _ppo_policy), "ddpg": (_ddpg, _ddpg_policy)}
"""(config, environment, seed, state) -> algorithm, and algorithm -> policy."""


# ---------------------------------------------------------------- state -> Stable-Baselines3 -> state

_ADAM = ("step", "exp_avg", "exp_avg_sq")
"""What PyTorch's Adam keeps of a parameter."""
_REPLAY = ("observations", "next_observations", "actions", "rewards", "dones")
"""The arrays of the replay buffer; the last is 1 where the episode ended."""


def new_model(config: Config, env: Monitor, seed: int, state: SB3State | None) -> Any:
    """The algorithm as `state` left it (None: fresh); all its randomness and the environment's come from `seed`."""
    torch.set_num_threads(1)
    model = _METHODS[config.method][0](config, env, seed, state)
    model.set_logger(Logger(None, []))
    if state is None:
        return model
    model.num_timesteps = state.real_steps
    model.policy.load_state_dict({name: torch.from_numpy(value) for name, value in state.parameters.items()})
    _statistics(model).put(state.statistics)
    for optimiser, memories in zip(_optimisers(model), state.adam, strict=True):
        for parameter, memory in zip(_parameters(optimiser), memories, strict=True):
            optimiser.state[parameter] = dict(zip(_ADAM, map(torch.tensor, memory), strict=True))
    if state.replay:
        _put_replay(model.replay_buffer, state.replay)
    return model


def state_of(config: Config, model: Any, iteration: int) -> SB3State:
    """What the next iteration needs of a model."""
    return SB3State(
        iteration=iteration,
        real_steps=model.num_timesteps,
        policy=_METHODS[config.method][1](model),
        parameters={name: _numpy(value) for name, value in model.policy.state_dict().items()},
        adam=tuple(_memories(optimiser) for optimiser in _optimisers(model)),
        statistics=_statistics(model).sums,
        replay=_get_replay(model.replay_buffer) if config.method == "ddpg" else {},
    )


def _optimisers(model: Any) -> list[Any]:
    return [module.optimizer for module in model.policy.modules() if getattr(module, "optimizer", None)]


def _memories(optimiser: Any) -> tuple[tuple[np.ndarray, ...], ...]:
    def memory(parameter: Any) -> tuple[np.ndarray, ...]:
        # Adam makes it, of zeros, at the first update; the state's structure must be there before.
        fresh = {name: torch.zeros(() if name == "step" else parameter.shape) for name in _ADAM}
        return tuple(_numpy(optimiser.state.get(parameter, fresh)[name]) for name in _ADAM)

    return tuple(memory(parameter) for parameter in _parameters(optimiser))


def _parameters(optimiser: Any) -> list[Any]:
    return [parameter for group in optimiser.param_groups for parameter in group["params"]]


def _put_replay(buffer: Any, replay: dict[str, np.ndarray]) -> None:
    size = len(replay["rewards"])
    for name in _REPLAY:
        getattr(buffer, name)[:size, 0] = replay[name]
    buffer.pos, buffer.full = size % buffer.buffer_size, size == buffer.buffer_size


def _get_replay(buffer: Any) -> dict[str, np.ndarray]:
    oldest = buffer.pos if buffer.full else 0
    return {name: np.roll(getattr(buffer, name)[: buffer.size(), 0], -oldest, axis=0) for name in _REPLAY}


def _numpy(tensor: Any) -> np.ndarray:
    return np.array(tensor.detach().numpy(), order="C")
