"""What a shield costs, and where its proof ends: `python -m benchmarks.shield COMMAND`.

Commands: cost, decision, board, memory, containment, mismatch.
"""

from __future__ import annotations

import gc
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import cvxpy as cp
import gymnasium as gym
import numpy as np
from scipy.optimize import minimize_scalar

from benchmarks.commands import run, table
from benchmarks.random_plants import random_plant
from benchmarks.timing import Steps, microseconds, resident, timed
from experiments.commands.attack import hostile_agents, starts, worst_case
from ncs_gym import (
    Bounds,
    Channel,
    ChannelContract,
    Limits,
    LinearPlant,
    Model,
    NCSEnv,
    NCSVectorEnv,
    Packet,
)
from ncs_gym.ellipsoid import outer_sum
from ncs_gym.envs.env import ncs_env
from ncs_gym.network.packet_loss_and_delay import ChannelState
from ncs_gym.registration import EPISODE_STEPS
from shields import SafeLoop, SafetyFilter, SafetyShield, VectorSafetyShield, certificate_for, synthesize
from shields.export import BoardFilter, BoardTable
from shields.export.board_filter import GUARANTEED
from shields.runtime.safety_filter import MARGIN

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
# Steps for which proposals to a board push the same way.
HELD = 10


def cost(seconds: float = 1.0) -> None:
    """What the shield costs in time: steps per CPU second without it, behind the one-step test and behind lookahead.

    Actions are random; each row is measured once for one environment and once for 64 side by side, --seconds each.
    """
    count = 64
    shields: dict[str, dict[str, Any] | None] = {
        "no shield": None,
        "project": {"mode": "project"},
        "lookahead": {"mode": "lookahead"},
    }
    show = table("steps per second", *shields, first=24, width=12)
    for name in ("TruckTrailerCruise-v0", "CartPole-v0", "BatchReactor-v0", "Convoy-v0"):
        singles: list[Any] = []
        batches: list[Any] = []
        for shield in shields.values():
            single, many = gym.make(f"ncs_gym/{name}"), gym.make_vec(f"ncs_gym/{name}", num_envs=count)
            if shield is not None:
                single = SafetyShield(single, on_unproved="ignore", **shield)
                many = VectorSafetyShield(many, on_unproved="ignore", **shield)
            singles.append(single)
            batches.append(many)
        for label, envs in {name: singles, f"  {count} side by side": batches}.items():
            rates = []
            for env in envs:
                steps = Steps(env)
                steps.seconds(seconds)  # patterns of arrivals are worked out when they occur first
                rates.append(f"{1.0 / steps.seconds(seconds):,.0f}")
            show(label, *rates)


class ConicFilter:
    """The same projection solved per step: minimize |u - proposed|^2 in the test and the limits (DPP, Clarabel)."""

    def __init__(self, shield: SafetyFilter) -> None:
        n, m = shield.plant.n, shield.plant.m
        self.shield, self.u = shield, cp.Variable(m)
        self.proposed, self.offset = cp.Parameter(m), cp.Parameter(n)
        self.effect, self.radius = cp.Parameter((n, m)), cp.Parameter()
        reached = cp.norm(self.offset + self.effect @ self.u)
        constraints = [reached <= self.radius - MARGIN, cp.abs(self.u) <= shield.plant.largest_input]
        self.problem = cp.Problem(cp.Minimize(cp.sum_squares(self.u - self.proposed)), constraints)

    def decide(self, estimate: np.ndarray, error_shape: np.ndarray, proposed: np.ndarray) -> np.ndarray:
        test, plant = self.shield.test, self.shield.plant
        predicted = outer_sum(test.state_rows @ error_shape @ test.state_rows.T, test.D, np.eye(plant.n))
        values, axes = np.linalg.eigh(predicted)
        h = np.sqrt(values[-1])
        weighting = np.sqrt(h * (1.0 - h) / (h - values))[:, None] * axes.T
        self.proposed.value, self.radius.value = proposed, 1.0 - h
        self.offset.value, self.effect.value = weighting @ test.state_rows @ estimate, weighting @ test.input_rows
        self.problem.solve(solver=cp.CLARABEL)
        if self.u.value is not None and self.problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
            return self.u.value
        return np.clip(self.shield.certificate.K @ estimate, -plant.largest_input, plant.largest_input)


def recorded(env: NCSEnv, shield: SafetyFilter, steps: int) -> list[tuple[np.ndarray, ...]]:
    """Estimate, error shape and proposal of every step of shielded episodes under a random policy."""
    shielded, rng, cases = SafetyShield(env, shield.certificate), np.random.default_rng(0), []
    while len(cases) < steps:
        _, info = shielded.reset(seed=len(cases))
        for _ in range(min(200, steps)):
            action = rng.uniform(-1, 1, shield.plant.m).astype(np.float32)
            cases.append(
                (info["estimate"], info["error_shape"], shield.plant.largest_input * action.astype(np.float64))
            )
            *_, info = shielded.step(action)
    return cases[:steps]


def decision(steps: int = 400) -> None:
    """Microseconds of one decision of mode "project", by outcome, against the same filter in cvxpy.

    "ratio" is cvxpy's median time over ours; "too far" is how much farther our input lies from the proposed one than
    the solver's, at most, relative to that distance. Estimates, error ellipsoids and proposals come from episodes of
    the registered environment (one input) and of random plants under a random policy, so that the mix of passed,
    projected and fallback decisions is the one met in use.
    """
    channel, reasons = (
        Channel(loss=0.3, quantization_step=0.01, send_period=2, delay=2),
        ("safe", "projected", "fallback"),
    )
    envs: dict[str, NCSEnv] = {"TruckTrailerCruise-v0": ncs_env(gym.make(CRUISE))}
    for n, m in ((4, 1), (4, 2), (4, 3), (8, 3)):
        envs[f"random, n = {n}, m = {m}"] = NCSEnv(random_plant(n, n, m, gamma=1e-4), channel)
    show = table("our decision [us]", "median", *reasons, "cvxpy", "ratio", "overridden", "too far", first=24)
    for name, env in envs.items():
        shield = SafetyFilter(synthesize(env.plant, safe_set="ellipsoid"), env.plant)
        conic, cases, by_reason = ConicFilter(shield), recorded(env, shield, steps), defaultdict(list)
        for case in cases:
            by_reason[shield.decide(*case).reason].append(case)
        ours = np.median(microseconds(shield.decide, cases))
        parts = {reason: np.median(microseconds(shield.decide, some)) for reason, some in by_reason.items()}
        theirs = np.median(microseconds(conic.decide, cases))
        gaps = [0.0]
        for case in by_reason["projected"]:
            far, least = (np.linalg.norm(u - case[2]) for u in (shield.decide(*case).input, conic.decide(*case)))
            gaps.append(float((far - least) / max(least, 1e-3 * float(env.plant.largest_input.max()))))
        columns = [f"{parts[reason]:.1f}" if reason in parts else "-" for reason in reasons]
        share = 1 - len(by_reason["safe"]) / len(cases)
        show(
            name, f"{ours:.1f}", *columns, f"{theirs:.0f}", f"{theirs / ours:.0f}x", f"{share:.1%}", f"{max(gaps):.1e}"
        )


def board(names: tuple[str, ...] = ("LaneKeeping", "CSTR", "BatchReactor", "CartPole"), steps: int = 4_000) -> None:
    """Which share of proposals a filter on a board overrides, and a `SafeLoop`, on the channel of an environment.

    Proposals are the fallback's inputs plus noise of a share of the limits, held for ten steps.
    """
    show = table("overridden [%]", "noise", "SafeLoop", "double", "float", first=14)
    for name in names:
        env = ncs_env(gym.make(f"ncs_gym/{name}-v0"))
        certificate = certificate_for(env.plant, env.certificate_contract)
        tables = [BoardTable.of(certificate, env.plant, single=single) for single in (False, True)]
        for noise in (0.3, 1.0):
            shares = [_overridden(certificate, env, noise, steps, each) for each in (None, *tables)]
            show(name, noise, *(f"{100.0 * share:.1f}" for share in shares))


def _overridden(certificate: Any, env: NCSEnv, noise: float, steps: int, numbers: BoardTable | None) -> float:
    """Returns the share of proposals that a `SafeLoop`, or a board with such numbers, overrides."""
    plant, rng = env.plant, np.random.default_rng(0)
    on_air = ChannelState(replace(env.channel, delay=env.channel.delay - 1), rng)  # received at the next step
    state, packets, count, push = certificate.resting_state, [], 0, np.zeros(plant.m)
    if numbers is None:
        loop = SafeLoop(certificate, plant, env.channel, on_unproved="ignore")
        loop.start(state)
    else:
        filtered = BoardFilter(numbers, 0, state)
    for step in range(steps):
        if step % HELD == 0:
            push = noise * rng.uniform(*plant.input_ends)
        if numbers is None:
            wanted = np.clip(push + certificate.K @ loop.receive(packets), *plant.input_ends)
            u = loop.decide(wanted).input
            assert loop.guaranteed, loop.reason
        else:
            for packet in sorted(packets, key=lambda each: each.stamp):
                filtered.receive(packet.episode, packet.stamp, packet.measurement)
            wanted = np.clip(push + certificate.K @ filtered.estimate, *plant.input_ends)
            u = filtered.decide(wanted)[1]
            assert filtered.reason == GUARANTEED
        count += bool((u != wanted).any())
        y = plant.H @ state + plant.nominal_sensor_error.sample_boundary(rng)
        packets = on_air.carry(rng, step, Packet(step, env.channel.quantize(y)))
        state = plant.A @ state + plant.B @ u + plant.nominal_disturbance.sample_boundary(rng)
    return count / steps


def memory(steps: int = 100_000) -> None:
    """By how much the memory of a `SafeLoop` has grown after a tenth and after all steps of an episode.

    The plant is a motor with angle [rad], speed [rad/s] and current [A], of which the speed is not measured: what its
    sensors say is worth averaging over many samples, so that arrival histories hardly recur.
    """
    model = np.array([[0.0, 1.0, 0.0], [0.0, -2.0, 20.0], [0.0, -0.5, -10.0]]), np.array([[0.0], [0.0], [10.0]])
    plant = LinearPlant(
        Model.sampled(*model, [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], 0.01),
        Limits(state=[1.0, 5.0, 3.0], input=5.0),
        Bounds(disturbance=[5e-4, 5e-3, 5e-3], sensor=[2e-3, 0.01], first_error=[2e-3, 0.01, 0.01]),
    )
    channel, rng, x = Channel(loss=0.2, max_consecutive_losses=2), np.random.default_rng(0), np.zeros(3)
    loop = SafeLoop(synthesize(plant, contract=ChannelContract(2), safe_set="ellipsoid"), plant, channel)
    state, packets = ChannelState(channel, rng), []
    gc.disable()
    loop.start(x)
    first = resident()
    for step in range(steps):
        loop.receive(packets)
        u = loop.decide(rng.uniform(-1.0, 1.0, 1) * plant.largest_input).input
        if step in (steps // 10, steps - 1):
            print(f"{step + 1:12,} steps: {resident() - first:.1f} MB", flush=True)
        x = plant.A @ x + plant.B @ u + plant.process_noise.sample(rng)
        y = plant.H @ x + plant.sensor_noise.sample(rng)
        packets = state.exchange(rng, step + 1, y if state.sends_at(step + 1) else None, loop.episode)
    assert loop.guaranteed, loop.reason


def exact(shield: SafetyFilter, estimate: np.ndarray, error_shape: np.ndarray, u: np.ndarray) -> bool:
    """Whether everything one step can reach lies in S, with the best s."""
    test = shield.test
    predicted = outer_sum(test.state_rows @ error_shape @ test.state_rows.T, test.D, np.eye(shield.plant.n))
    p, axes = np.linalg.eigh(predicted)
    c = axes.T @ (test.state_rows @ estimate + test.input_rows @ u)
    if p[-1] >= 1.0:
        return False
    bounds = (p[-1] * (1.0 + 1e-9), 1.0)
    best: Any = minimize_scalar(lambda s: (c**2 * s / (s - p)).sum() + s, bounds=bounds, method="bounded")
    return best.fun <= 1.0


def containment(episodes: int = 15) -> None:
    """How much intervention a sharper one-step test saves: fraction of actions overridden by each of three tests.

    In coordinates where M = I, with p the eigenvalues of the predicted ellipsoid, c its center and h = sqrt(max p): all
    of it lies in S if some s in (max p, 1) has sum_i c_i^2 s/(s - p_i) + s <= 1. "norm" is |c| <= 1 - h, "shield" takes
    s = h (what the shield does), "exact" the best s. Each judges the same proposals, made in shielded episodes.
    """
    rng = np.random.default_rng(0)
    policies: dict[str, Callable[[int, int], np.ndarray]] = {
        "uniformly random": lambda step, episode: rng.uniform(-1, 1, 1),
        "slow sine with noise": lambda step, episode: np.clip(
            0.5 * np.sin(step / 15 + episode) + 0.3 * rng.standard_normal(1), -1, 1
        ),
        "full throttle, random sign": lambda step, episode: np.sign(rng.standard_normal(1)),
    }
    show = table(f"{'overridden by each test':26}policy", "norm", "shield", "exact", "exact [us]", first=54)
    for env_id in ("ncs_gym/TruckTrailer-v0", CRUISE):
        plant = ncs_env(gym.make(env_id)).plant
        env = SafetyShield(gym.make(env_id), synthesize(plant, safe_set="ellipsoid"))
        rng = np.random.default_rng(0)  # which the policies draw from
        for name, act in policies.items():
            turned_down, seconds = np.zeros(3), 0.0
            for episode in range(episodes):
                _, info = env.reset(seed=episode)
                for step in range(EPISODE_STEPS):
                    action = act(step, episode).astype(np.float32)
                    case = info["estimate"], info["error_shape"], plant.largest_input * action.astype(np.float64)
                    sets = env.filter.test.reachable(case[0][:, None], env.filter.errors_of(case[1]).batch())
                    test_margin, margin = (each.item() for each in sets.margins(case[2][:, None]))
                    contained, taken = timed(exact, env.filter, *case)
                    seconds += taken
                    turned_down += margin < MARGIN, test_margin < MARGIN, not contained
                    *_, info = env.step(action)
            count = episodes * EPISODE_STEPS
            shares = [f"{share:.1%}" for share in turned_down / count]
            show(f"{env_id.removeprefix('ncs_gym/'):26}{name}", *shares, f"{1e6 * seconds / count:.0f}")


def mismatch(
    env: str = "ncs_gym/Pendulum-v0",
    field: str = "mass",
    values: Sequence[float] = (0.5, 0.8, 0.9, 0.95, 0.99, 1.0, 1.01, 1.05, 1.1, 1.2, 1.5, 2.0),
    episodes: int = 32,
    seed: int = 0,
) -> None:
    """Where the proof ends and violations begin when the process has another mass, or other --field, than the model.

    For every value: the largest step outside the model in units of its bound over box x limits (the proof holds up to
    1), then shielded episodes with worst-case packets, sensor noise, starts and hostile agents. The table says how many
    episodes left the safe set or the box, in how many the estimator's own monitor of innovations raised an alarm (it
    sees packets only), in how many of those that left the box it did so before or at that step, and in how many the
    simulation, which sees the true state, saw a step outside the model.
    """
    model = ncs_env(gym.make(env))
    certificate = certificate_for(model.plant, model.certificate_contract)
    print(f"{env}, {episodes} shielded episodes of {EPISODE_STEPS} steps for each {field}\n")
    titles = ("outside the model", "left S", "left box", "alarm", "before box", "simulation's alarm")
    show = table(field, *titles, first=max(4, len(field)), width=0)
    for value in values:
        process = ncs_env(gym.make(env, process={field: value})).process
        outside = _largest_step_outside(model.plant, process, np.random.default_rng(seed))
        first = _attacked(model, process, certificate, episodes, seed)
        left, warned = np.isfinite(first["box"]), first["alarm"] <= first["box"]
        counts = {name: int(np.isfinite(steps).sum()) for name, steps in first.items()}
        before = f"{int((warned & left).sum())}/{int(left.sum())}" if left.any() else "-"
        several = [counts[name] for name in ("set", "box", "alarm")]
        show(f"{value:>{max(4, len(field))}g}", f"{outside:.2f}", *several, before, counts["simulation"])


def _largest_step_outside(plant: LinearPlant, process: Any, rng: np.random.Generator) -> float:
    """Largest gauge of x+ - A x - B u in E(D) over samples of box x limits, corners among them."""
    moving = process.opened(plant, None)
    widths = np.concatenate([plant.half_widths, plant.largest_input])
    largest = 0.0
    for number in range(4_000):
        point = widths * rng.uniform(-1.0, 1.0, len(widths))
        point = widths * np.sign(point) if number % 2 else point
        x, u = point[: plant.n], point[plant.n :]
        if moving.terminated or moving.truncated:
            moving.start(rng, x, None)
        x_next = moving.step(plant, moving.write(x), u)
        largest = max(largest, plant.disturbance.gauge(x_next - plant.A @ x - plant.B @ u))
    moving.close()
    return largest


def _attacked(env: NCSEnv, process: Any, certificate: Any, episodes: int, seed: int) -> dict[str, np.ndarray]:
    """First steps, one per episode, of leaving S or the box and of both alarms; inf for never."""
    settings = {"plant": env.plant, "channel": env.channel, "contract": env.contract, "process": process}
    many = NCSVectorEnv(episodes, **settings, **worst_case(certificate))
    shield, rng = VectorSafetyShield(many, certificate, on_unproved="ignore"), np.random.default_rng(seed)
    _, info = shield.reset(seed=seed, options={"state": starts(certificate, rng, episodes)})
    act = hostile_agents(certificate, env.plant, episodes, rng)
    first = {name: np.full(episodes, np.inf) for name in ("set", "box", "alarm", "simulation")}
    for step in range(1, EPISODE_STEPS + 1):
        *_, info = shield.step(act(info["estimate"]))
        now = {
            "set": ~(certificate.safe_set.gauge(info["state"]) <= 1.0),
            "box": info["cost"] > 0.0,
            "alarm": many._now.estimator.alarm,
            "simulation": many._now.process.alarm,
        }
        for name, seen in now.items():
            first[name] = np.where(seen, np.minimum(first[name], step), first[name])
    shield.close()
    return first


COMMANDS = (cost, decision, board, memory, containment, mismatch)

if __name__ == "__main__":
    run(__doc__, COMMANDS)
