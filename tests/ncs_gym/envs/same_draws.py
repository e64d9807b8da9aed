"""Scalar shields, vector shields and loops fed with the same draws, bare environments too, compared at every step."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from ncs_gym import LinearPlant, NCSEnv, NCSVectorEnv
from ncs_gym.network.packet_loss_and_delay import ChannelState, LossState
from ncs_gym.plants.lqr import regulator_gain
from ncs_gym.processes.plant_step import PlantSimulation
from shields import Certificate, SafetyShield
from shields.runtime.guard import OUTSIDE_BOUND
from tests import arrays
from tests.certificates import metric
from tests.product import safe_loop, safety_shield, vector_shield


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
        self.many, self.index = many, index

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple:
        """Begins in the state of the episode that its environment of the vector has just begun."""
        many, index = self.many, self.index
        self.np_random, self._task_random = np.random.default_rng(0), None
        links = {"channel": many.episode_channels[index], "downlink": many.episode_downlinks[index]}
        super().reset(options={"state": many._now.state[:, index], **links})
        if np.isnan(many.starts[index]).any():
            self._now.start = self.initial_set
        self._now.process = ScriptedProcess(self.plant, self.disturbance, self.allow_assumption_violation)
        if (parameters := many._now.process.process.parameters) is not None:
            self._now.process.process.choose(np.random.default_rng(0), None, parameters[index])
        self._now.estimator.reset(many._now.estimator.mean[:, index])
        self._task_state = np.copy(many._task_state[..., index])[()]
        self._now.memory = np.copy(many._now.memory[..., index])[()]
        self._now.network = ChannelState(self.episode_channel, np.random.default_rng(0))
        self._now.network._loss_state = LossState(*(kept[index] for kept in many._now.network._loss_state))
        self._now.downlink.begin(np.random.default_rng(0))
        if self.downlink is not None:
            states = many._now.downlink._channel_state._loss_state
            self._now.downlink.in_flight._loss_state = LossState(*(kept[index] for kept in states))
        self.np_random, self._task_random, self._now.violations = ScriptedGenerator(), ScriptedGenerator(), 0.0
        self._belief, info = self._now.report()
        if self.guard is not None:
            self.guard.begin(self._belief, *self._now.beginning())
            info |= self.guard.info()
        return self._observation(), info

    def step(self, action: np.ndarray) -> tuple:
        self.hear()
        result = super().step(action)
        sends = self._now.network.sends_at(self.steps)
        assert not (sends and self.np_random.numbers)  # where nothing is sent, less is drawn
        return result

    def go_on_from(self, state: np.ndarray) -> None:
        """Takes over a state that is the same but for rounding, which unstable plants enlarge."""
        self._now.state = state.copy()

    def hear(self) -> None:
        process, rng = self.many._now.process, self.many.np_random
        self._now.process.disturbance_now = process.disturbance_now[:, self.index]
        self._now.process.noise_now = process.noise_now[:, self.index]
        self.np_random.numbers = [drawn[..., self.index] for drawn in rng.drawn]
        self._task_random.numbers = [drawn[..., self.index] for drawn in self.many._task_random.drawn]


def scalar_versions(many: NCSVectorEnv) -> list[ScriptedEnv]:
    """Scalar environments that follow each environment of a vector, which is made to record."""
    single = many.single
    allowed = single.allow_assumption_violation
    moving = many._now.process.process
    many._now.process = RecordedProcess(many.plant, single.disturbance, allowed, many.num_envs, noise=single.noise)
    many._now.process.process = moving  # with the members of families that the reset has drawn
    many._now.process.noise_now = np.zeros((many.plant.p, many.num_envs))
    many.np_random = rng = RecordingGenerator(many.np_random)
    many._task_random = of_task = RecordingGenerator(many._task_random)
    begin = many._begin

    def begin_unnoticed(*arguments: Any) -> Any:
        rng.notes = of_task.notes = False
        begun = begin(*arguments)
        rng.notes = of_task.notes = True
        return begun

    many._begin = begin_unnoticed
    names = "plant channel task disturbance initial_set terminate_on_violation contract horizon noise observe"
    settings = {name: getattr(single, name) for name in (*names.split(), "allow_assumption_violation")}
    if single.downlink is not None:
        settings |= {"downlink": single.downlink, "downlink_contract": single.downlink_protocol.contract}
    singles = [ScriptedEnv(**settings) for _ in range(many.num_envs)]
    for index, each in enumerate(singles):
        each.follow(many, index)
    return singles


def holding_gain(plant: LinearPlant) -> np.ndarray:
    """A gain on actions that keeps an unstable plant near zero, where rounding does not grow without end."""
    if plant.spectral_radius < 1.0:
        return np.zeros((plant.m, plant.n))
    scale = np.diag(plant.half_widths)
    inverse = np.linalg.inv(scale)
    return regulator_gain(inverse @ plant.A @ scale, inverse @ plant.B * plant.input_half, 1, 1) @ inverse


class LoopBeside:
    """A loop without Gymnasium that is handed what the estimator of a scalar environment is given."""

    def __init__(self, shield: SafetyShield) -> None:
        self.shield, self.loops, self.packets = shield, {}, []

    def start(self, info: dict[str, Any]) -> None:
        env, channel = self.shield.unwrapped, self.shield.unwrapped.episode_channel
        if channel not in self.loops:
            behind = {"downlink": env.downlink, "downlink_contract": env.downlink_contract, "on_unproved": "ignore"}
            made = self.shield.filter
            given = self.shield.certificate, env.plant, channel, made.mode, made.horizon
            self.loops[channel] = safe_loop(*given, **behind)
        self.loop, estimator = self.loops[channel], env._now.estimator
        vars(estimator).pop("advance", None)
        advance = estimator.advance

        def overheard(u: Any, packets: Any) -> None:
            self.packets = list(packets)
            advance(u, self.packets)

        estimator.advance = overheard
        self.loop.start(estimator.mean, initial_set=env.start)
        self.sent = info["packets"]
        self.assert_same(info)

    def pickle(self) -> None:
        self.loop = self.loops[self.loop.channel] = pickle.loads(pickle.dumps(self.loop))

    def decide(self, action: np.ndarray, *, ask: bool) -> None:
        plant = self.loop.filter.plant
        self.decision = self.loop.decide(
            plant.input_middle + plant.input_half * np.asarray(action, np.float64), ask=ask
        )

    def compare(self, info: dict[str, Any]) -> None:
        """Compares the decision with the shield's, and then what both make of the step."""
        arrays.assert_equal(self.decision.input, info.get("input_committed", info["input"]))
        arrays.assert_equal(self.decision.margin, info["shield_margin"])
        assert self.decision.intervened == info["shield_intervened"]
        if self.loop.channel.on_request:
            assert self.loop.request <= (info["packets"] > self.sent)  # what is not heard is sent
        self.sent = info["packets"]
        told = info["input"] if info.get("downlink_broken") else None
        self.loop.receive([each._replace(episode=self.loop.episode) for each in self.packets[::-1]], applied=told)
        self.assert_same(info)

    def assert_same(self, info: dict[str, Any]) -> None:
        arrays.assert_close(self.loop.estimate, info["estimate"], rtol=1e-9, atol=1e-12)
        arrays.assert_close(self.loop.error_shape, info["error_shape"], rtol=1e-9, atol=1e-15)
        assert (self.loop.measurement_age, self.loop.steps) == (info["measurement_age"], self.shield.unwrapped.steps)
        if info["shield_reason"] == OUTSIDE_BOUND:  # which no loop sees, until a measurement shows it
            assert not info["shield_guaranteed"]
            return
        assert (self.loop.guaranteed, self.loop.reason) == (info["shield_guaranteed"], info["shield_reason"])
        assert self.loop.plan_length == info.get("shield_plan_length", 0)


@dataclass
class Seen:
    alarms: int = 0
    interventions: int = 0
    plans: int = 0
    forced: int = 0
    broken: int = 0
    reasons: set[str] = field(default_factory=set)

    def note(self, infos: dict[str, Any]) -> None:
        self.alarms += int(infos["assumption_violated"].sum())
        self.broken += int(infos["contract_broken"].sum())
        self.interventions += int(np.sum(infos.get("shield_intervened", 0)))
        self.plans += int(np.sum(infos.get("shield_plan_length", 0)))
        self.forced += int(np.sum(infos.get("request_forced", 0)))
        self.reasons |= set(infos.get("shield_reason", ()))


def compare(
    many: NCSVectorEnv,
    steps: int,
    options: dict[str, Any] | None = None,
    certificate: Certificate | None = None,
    mode: str = "project",
    anew: tuple[int, ...] = (),
) -> Seen:
    """Steps a vector and, with the same draws, scalar environments; compares everything that both say.

    With a certificate all are shielded, and a loop without Gymnasium runs beside each scalar shield. The options are of
    the first reset; before the steps in `anew` every third environment is reset alone.
    """
    shielded = certificate is not None
    settings = {"mode": mode, "penalty": 0.25, "on_unproved": "ignore"}
    outer = vector_shield(many, certificate, **settings) if shielded else many
    _, infos = outer.reset(seed=3, options=options)
    singles = scalar_versions(many)
    outers = [safety_shield(each, certificate, **settings) if shielded else each for each in singles]
    loops = [LoopBeside(each) for each in outers] if shielded else []
    rng, gain, seen = np.random.default_rng(0), holding_gain(many.plant), Seen()
    seen.note(infos)
    # Without a shield that keeps it there, nothing may drive an unstable plant out of its box.
    held = gain.any() and (not shielded or mode == "monitor")
    over = np.zeros(many.num_envs, np.bool_)
    push = many.plant.weight @ many.plant.A if certificate is None else metric(certificate) @ many.plant.A
    rtol, atol = (1e-5, 1e-7) if shielded else (1e-10, 1e-10)  # where actions are rounded to float32, or not

    def begin(index: int, infos: dict[str, Any]) -> None:
        _, info = outers[index].reset()
        assert_same("reset", info, infos, index, rtol, atol)
        if shielded:
            loops[index].start(info)

    for index in range(many.num_envs):
        begin(index, infos)
    for number in range(steps):
        if number in anew:
            chosen = np.arange(many.num_envs) % 3 == 0
            chosen |= many.autoreset_mode is AutoresetMode.NEXT_STEP and over
            _, infos = outer.reset(options=(options or {}) | {"reset_mask": chosen})
            for index in np.flatnonzero(chosen).tolist():
                begin(index, infos)
            if shielded:
                loops[-1].pickle()
        actions = rng.uniform(-0.1 if held else -1.2, 0.1 if held else 1.2, many.action_space.shape)
        actions += infos["estimate"] @ gain.T if held else 0.0
        if shielded and not held and number % 2:
            actions = np.sign(infos["estimate"] @ push.T @ many.plant.B + 1e-12)
        actions, episodes = actions.astype(np.float32), many.episodes.copy()
        many.np_random.drawn = []
        many._task_random.drawn = []
        asked = np.zeros(many.num_envs, np.bool_)
        if many.channel.on_request:
            asked = rng.random(many.num_envs) < 0.2
            many.request(asked)
        observations, rewards, terminated, truncated, infos = outer.step(actions)
        over = terminated | truncated
        seen.note(infos)
        for index, single in enumerate(singles):
            begun, last = many.episodes[index] != episodes[index], (observations, infos)
            if begun and many.autoreset_mode is AutoresetMode.SAME_STEP:
                last = infos["final_obs"], infos["final_info"]
            elif begun:
                assert (rewards[index], terminated[index], truncated[index]) == (0.0, False, False)
                begin(index, infos)
                continue
            if many.channel.on_request:
                single.request(bool(asked[index]))
            if shielded:
                loops[index].decide(actions[index], ask=bool(asked[index]))
            observation, reward, done, _, info = outers[index].step(actions[index])
            arrays.assert_close(last[0][index], observation, rtol=max(rtol, 1e-6), atol=atol)
            arrays.assert_close(rewards[index], reward, rtol=rtol, atol=atol)
            assert terminated[index] == done
            assert_same(number, info, last[1], index, rtol, atol)
            if shielded:
                loops[index].compare(info)
            if begun:
                begin(index, infos)
            elif gain.any():  # an unstable plant makes 1e-17 of rounding 1e-10 in an episode
                single.go_on_from(infos["state"][index])
    return seen


def assert_same(where: Any, single: dict[str, Any], many: dict[str, Any], index: int, rtol: float, atol: float) -> None:
    assert set(single) == {key for key in many if not key.startswith(("_", "final_"))}
    for key, value in single.items():
        if isinstance(value, str):
            assert value == many[key][index], (where, key)
            continue
        arrays.assert_close(many[key][index], value, rtol=rtol, atol=atol, where=(where, key))
        assert np.asarray(value).dtype.kind == many[key].dtype.kind, key
