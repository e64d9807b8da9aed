"""Scalar environments that are fed with what a vector environment draws, and the comparison of both at every step."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from ncs_gym import LinearPlant, NCSEnv, NCSVectorEnv
from ncs_gym.network.packet_loss_and_delay import ChannelState, LossState
from ncs_gym.plants.lqr import regulator_gain
from ncs_gym.processes.plant_step import PlantSimulation
from tests import arrays


class RecordingGenerator:
    """A source of randomness that notes the uniform numbers it hands out in a step; other draws are passed on."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng, self.drawn, self.notes = rng, [], True

    def random(self, size: Any = None) -> np.ndarray:
        numbers = self.rng.random(size)
        if self.notes:
            self.drawn.append(numbers)
        return numbers

    def __getattr__(self, name: str) -> Any:
        return getattr(self.rng, name)


class ScriptedGenerator:
    """Hands out what was drawn for one environment of a vector, in the same order."""

    def __init__(self) -> None:
        self.numbers: list[np.ndarray] = []

    def random(self, size: Any = None) -> Any:
        number = self.numbers.pop(0)
        assert np.shape(number) == (() if size is None else size)
        return number


class RecordedProcess(PlantSimulation):
    """The process of a vector, which notes noise and disturbances; those do not count among the uniform numbers."""

    def draw_disturbance(self, rng: Any, nominal: np.ndarray, steps: Any, memory: Any) -> np.ndarray:
        self.steps, self.disturbance_now = np.copy(steps), super().draw_disturbance(rng.rng, nominal, steps, memory)
        return self.disturbance_now

    def measure(self, rng: Any, state: np.ndarray) -> np.ndarray:
        measured = super().measure(rng.rng, state)
        self.noise_now = measured - self.plant.H @ state
        return measured


class ScriptedProcess(PlantSimulation):
    """The process of a scalar environment with the noise and the disturbances of one environment of a vector."""

    def draw_disturbance(self, rng: Any, nominal: np.ndarray, steps: Any, memory: Any) -> np.ndarray:
        source = self.disturbance
        if source.vectorized and not source.memoryless and source.replaces_process_noise:  # it is a function of these
            own = super().draw_disturbance(rng, nominal, steps, memory)
            np.testing.assert_allclose(own, self.disturbance_now, atol=1e-7)
        return self.disturbance_now

    def measure(self, rng: Any, state: np.ndarray) -> np.ndarray:
        return self.plant.H @ state + self.noise_now


class ScriptedEnv(NCSEnv):
    """The scalar environment fed with what one environment of a vector drew."""

    def follow(self, many: NCSVectorEnv, index: int) -> None:
        """Begins in the state of an episode of the vector that has just begun."""
        self.many, self.index = many, index
        self.np_random = np.random.default_rng(0)
        links = {"channel": many.episode_channels[index], "downlink": many.episode_downlinks[index]}
        self.reset(options={"state": many._state[:, index], **links})
        self._process = ScriptedProcess(self.plant, self.disturbance, self.allow_assumption_violation)
        self.estimator.reset(many._estimator.mean[:, index])
        self._task_state = np.copy(many._task_state[..., index])[()]
        self._disturbance_memory = np.copy(many._disturbance_memory[..., index])[()]
        self._channel_state = ChannelState(self.episode_channel, np.random.default_rng(0))
        self._channel_state._loss_state = LossState(*(kept[index] for kept in many._channel_state._loss_state))
        self._downlink_state.begin(np.random.default_rng(0))
        if self.downlink is not None:
            states = many._downlink_state._channel_state._loss_state
            self._downlink_state.in_flight._loss_state = LossState(*(kept[index] for kept in states))
        self.np_random = ScriptedGenerator()

    def replay(self, action: np.ndarray) -> tuple:
        """Steps with what the vector drew at its last step."""
        self.hear()
        result = self.step(action)
        sends = self._channel_state.sends_at(self.steps)
        assert not (sends and self.np_random.numbers)  # where nothing is sent, less is drawn
        return result

    def hear(self) -> None:
        """Takes over what the vector drew at its last step."""
        process, rng = self.many._process, self.many.np_random
        self._process.disturbance_now = process.disturbance_now[:, self.index]
        self._process.noise_now = process.noise_now[:, self.index]
        self.np_random.numbers = [drawn[..., self.index] for drawn in rng.drawn]


def scalar_versions(many: NCSVectorEnv, kind: type[ScriptedEnv] = ScriptedEnv) -> list[Any]:
    """Scalar environments that follow each environment of a vector, which is made to record."""
    single = many.single
    allowed = single.allow_assumption_violation
    many._process = RecordedProcess(many.plant, single.disturbance, allowed, many.num_envs, noise=single.noise)
    many._process.noise_now = np.zeros((many.plant.p, many.num_envs))
    many.np_random = rng = RecordingGenerator(many.np_random)
    begin = many._begin

    def begin_unnoticed(*arguments: Any) -> None:
        rng.notes = False
        begin(*arguments)
        rng.notes = True

    many._begin = begin_unnoticed
    names = (
        "plant",
        "channel",
        "task",
        "disturbance",
        "initial_set",
        "terminate_on_violation",
        "contract",
        "horizon",
        "noise",
    )
    settings = {name: getattr(single, name) for name in names}
    settings |= {name: getattr(single, name) for name in ("allow_assumption_violation", "observe")}
    if single.downlink is not None:
        settings |= {"downlink": single.downlink, "downlink_contract": single.downlink_protocol.contract}
    singles = [kind(**settings) for _ in range(many.num_envs)]
    for index, each in enumerate(singles):
        each.follow(many, index)
    return singles


def holding_gain(plant: LinearPlant) -> np.ndarray:
    """A gain on actions that keeps an unstable plant near zero, where rounding does not grow without end."""
    if plant.spectral_radius < 1.0:
        return np.zeros((plant.m, plant.n))
    scale = np.diag(plant.half_widths)
    inverse = np.linalg.inv(scale)
    return regulator_gain(inverse @ plant.A @ scale, inverse @ plant.B * plant.u_max, 1, 1) @ inverse


def compare(many: NCSVectorEnv, steps: int, options: dict[str, Any] | None = None) -> int:
    """Steps a vector and, with the same draws, scalar ones; compares everything; returns how many alarms there were."""
    many.reset(seed=3, options=options)
    singles, rng, gain = scalar_versions(many), np.random.default_rng(0), holding_gain(many.plant)
    width, alarms, estimates = 0.1 if gain.any() else 1.2, 0, np.zeros((many.num_envs, many.plant.n))
    for number in range(steps):
        actions = rng.uniform(-width, width, many.action_space.shape) + estimates @ gain.T
        actions, episodes = actions.astype(np.float32), many.episodes.copy()
        many.np_random.drawn = []
        if many.channel.on_request:
            asked = rng.random(many.num_envs) < 0.2
            many.request(asked)
            for single, asks in zip(singles, asked, strict=True):
                single.request(bool(asks))
        observations, rewards, terminated, _, infos = many.step(actions)
        for index, single in enumerate(singles):
            begun, last = many.episodes[index] != episodes[index], (observations, infos)
            if begun and many.autoreset_mode is AutoresetMode.SAME_STEP:
                last = infos["final_obs"], infos["final_info"]
            elif begun:
                single.follow(many, index)
                continue
            observation, reward, done, _, info = single.replay(actions[index])
            arrays.assert_close(last[0][index], observation, rtol=1e-6, atol=1e-10)
            arrays.assert_close(rewards[index], reward, rtol=1e-10, atol=1e-10)
            assert terminated[index] == done
            assert_same(number, info, last[1], index)
            if begun:
                single.follow(many, index)
                continue
            statistics = many._estimator.histories.table.statistics(many._estimator.statistics[index])
            arrays.assert_close(statistics.covariance, single.estimator.estimate.covariance, rtol=1e-10)
            if gain.any():  # an unstable plant makes 1e-17 of rounding 1e-10 in an episode
                single._state = infos["state"][index].copy()
        estimates = infos["estimate"]
        alarms += int(infos["assumption_violated"].sum())
    return alarms


def assert_same(number: int, single: dict[str, Any], many: dict[str, Any], index: int) -> None:
    for key, value in single.items():
        arrays.assert_close(many[key][index], value, rtol=1e-10, atol=1e-10, where=(number, key))
        assert np.asarray(value).dtype.kind == many[key].dtype.kind, key
