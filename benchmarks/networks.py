"""What contracts, networks both ways and requests cost: `python -m benchmarks.networks COMMAND`.

Commands: contracts, downlink, recorded, stalls, requests, gains.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Self

import gymnasium as gym
import matplotlib
import numpy as np
from gymnasium.vector import VectorEnv
from matplotlib.artist import Artist
from matplotlib.ticker import NullLocator
from scipy.stats import chi2
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from agents import SB3VecEnv
from agents.evaluation import Policy
from benchmarks.commands import run, some_of, table
from benchmarks.requests import (
    Asking,
    RequestsOnly,
    acknowledged,
    at_random,
    best_period,
    every,
    played,
    slack,
    with_rule,
)
from benchmarks.timing import timed
from experiments.baselines.controllers import REGULATORS, controller
from experiments.baselines.filters import EstimateFilterSettings
from experiments.baselines.tuned import tuned_weights
from experiments.figures import STYLE, CaptionedFigure, label, legend_below
from experiments.terminal import text_table
from ncs_gym import (
    Actuator,
    Channel,
    ChannelContract,
    LinearPlant,
    NCSEnv,
    NCSVectorEnv,
    PacketLog,
    VectorRequestActions,
    cart_pole,
)
from ncs_gym.ellipsoid import truncation_energy
from ncs_gym.envs.env import ncs_env
from ncs_gym.estimation.arrival_histories import ArrivalHistories, histories_of
from ncs_gym.estimation.estimator import Estimator
from ncs_gym.estimation.kalman_filter import ErrorRecursion, ErrorStatistics
from ncs_gym.network.downlink import CommittedInputs
from ncs_gym.plants.library import batch_reactor
from ncs_gym.registration import registered_ids
from shields import Certificate, SafetyShield, VectorSafetyShield, certificate_for, synthesize
from shields.paper.bounds import with_noise
from shields.synthesis.tolerance import most_tolerated

PLANTS = {
    "cart-pole, full state": cart_pole(),
    "cart-pole, position and angle": cart_pole(full_state=False),
    "batch reactor, two outputs": batch_reactor(),
}
# Colors of the plants in the figure, apart for color-blind readers (Okabe and Ito).
COLORS = ("#0072b2", "#e69f00", "#009e73")
# What gains bear is computed at this radius.
RADIUS = 1e-3


def contracts(ages: Sequence[int] = (1, 4, 8, 16), out: Path | None = None) -> None:
    """The largest disturbance that a gain bears, against the age that a contract allows, per unstable plant.

    Disturbance radii are in percent of the half-widths of the safe box; sensor noise and initial error are a hundredth
    of that. Seconds are those of a whole synthesis, with exact verification, at two thirds of that radius. With --out a
    figure of it, too.
    """
    show = table("plant", "max_age", "radius / box", "vol/ellipsoid", "synthesis [s]", first=32)
    radii_of: dict[str, list[float]] = {}
    for name, plant in PLANTS.items():
        radii = radii_of[name] = []
        for age in ages:
            contract = ChannelContract(age)
            radius = _largest_radius(plant, contract)
            within = _with_radius(plant, radius / 1.5)
            certificate, seconds = timed(synthesize, within, contract=contract, safe_set="ellipsoid")
            volume = certificate.provenance["volume_of_box_ellipsoid"]
            show(name, age, f"{radius:.3%}", f"{volume:.2f}", f"{seconds:.1f}")
            radii.append(100.0 * radius)
    if out is not None:
        out.write_bytes(_radii_drawn(ages, radii_of).png)


def _with_radius(plant: LinearPlant, radius: float) -> LinearPlant:
    """The plant with a disturbance of that fraction of the box, and a hundredth of it elsewhere."""
    half_widths, n = plant.half_widths, plant.n
    outputs = np.abs(plant.H) @ half_widths
    return with_noise(
        plant,
        Q=np.diag((radius * half_widths) ** 2) / truncation_energy(0.05, n),
        R=np.diag((0.01 * radius * outputs) ** 2) / truncation_energy(0.05, plant.p),
        P0=(0.01 * radius * half_widths.min()) ** 2 / truncation_energy(0.05, n) * np.eye(n),
    )


def _largest_radius(plant: LinearPlant, contract: ChannelContract) -> float:
    """The radius with which some gain just keeps a set: error sets grow with all radii."""
    found = most_tolerated(_with_radius(plant, RADIUS), contract, polytope=True)
    assert found is not None
    return RADIUS * found.margin


def _radii_drawn(ages: Sequence[int], radii_of: dict[str, list[float]]) -> CaptionedFigure:
    """The largest radius against the contract's age, for every plant."""
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((8.0, 3.8))
        axes, handles = figure.subplots(), {}
        for (name, radii), color, marker in zip(radii_of.items(), COLORS, "os^", strict=False):
            (handles[name],) = axes.semilogy(ages, radii, marker=marker, color=color, lw=1.5)
        label(
            axes,
            "largest age of the newest sample that the contract allows [steps]",
            "largest disturbance [% of the box]",
        )
        axes.set_xticks(ages)
        axes.set_yticks([0.1, 0.3, 1.0, 3.0])
        axes.yaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
        legend_below(figure, handles)
        return figure


# The picture: commands of steps 0 .. 7, one step late, of which one is lost; c = 2.
STEPS, LEAD, DELAY, LOST = 8, 2, 1, 3


def downlink(
    leads: Sequence[int] = (0, 1, 2, 4, 8),
    episodes: int = 200,
    envs: Sequence[str] = ("ncs_gym/TruckTrailerCruise-v0", "ncs_gym/CartPole-v0", "ncs_gym/BatchReactor-v0"),
    picture: Path | None = None,
) -> None:
    """What an imperfect downlink costs: safe set, overrides and return against the number c of steps it commits inputs.

    A downlink of c steps delays every command by c. The controller is the linear-quadratic regulator of `ncs compare
    --arms lqr+shielded`, for c = 0 as for every other c. The set is the certified one in the safe box; return and
    overrides are those of episodes with the same seed. --picture draws what one lost command does, which is simulated,
    in place of the table.
    """
    if picture is not None:
        picture.write_bytes(_lost_command().png)
        return
    show = table("environment", "c", "max_age", "S in box", "overridden", "return", "violations", first=24)
    for env_id in envs:
        for lead in leads:
            show(env_id.removeprefix("ncs_gym/"), lead, *_delayed(env_id, lead, episodes))


def _delayed(env_id: str, lead: int, episodes: int) -> tuple[str, ...]:
    """Returns the row of an environment whose commands are so many steps late."""
    settings: dict[str, Any] = {"downlink": Channel(delay=lead)} if lead else {}
    env = ncs_env(gym.make(env_id, **settings))
    certificate = certificate_for(env.plant, env.certificate_contract)
    shield = VectorSafetyShield(gym.make_vec(env_id, num_envs=episodes, **settings), certificate, on_unproved="ignore")
    policy = controller("lqr", env, certificate.fallback, 0)
    observation, info = shield.reset(seed=0)
    returns, overridden, steps, violations = np.zeros(episodes), 0.0, 0, 0.0
    running = np.ones(episodes, np.bool_)
    while running.any():
        observation, rewards, terminated, truncated, info = shield.step(policy(observation, info))
        returns += np.where(running, rewards, 0.0)
        overridden += np.count_nonzero(info["shield_intervened"] & running)
        violations += float(info["cost"][running].sum())
        steps += np.count_nonzero(running)
        running &= ~(terminated | truncated)
    age = "-" if env.certificate_contract is None else str(env.certificate_contract.max_age)
    share = certificate.provenance["share_of_box"]
    return age, f"{share:.1%}", f"{overridden / steps:.1%}", f"{returns.mean():.1f}", f"{violations:.0f}"


def _lost_command() -> CaptionedFigure:
    """Draws commands on their way, and from which of them each input that is applied comes."""
    queue, actuator = CommittedInputs(LEAD, 1), Actuator(LEAD, 1)
    flights, sources = [], []
    for step in range(STEPS):
        queue.commit(np.array([float(step + LEAD)]))
        flights.append(queue.command(step, 0))
        queue.pop()
        arrived = [each for each in flights if each.stamp + DELAY == step and each.stamp != LOST]
        actuator.receive(arrived)
        newest = max(
            (each.stamp for each in flights if each.stamp + DELAY <= step and each.stamp != LOST), default=None
        )
        sources.append((step, newest, actuator.apply(step).item(), actuator.missing))
    with matplotlib.rc_context(STYLE), matplotlib.rc_context({"axes.grid": False}):
        figure = CaptionedFigure((9.0, 3.9))
        axes = figure.subplots()
        axes.axhline(1.0, color="#555555", lw=1)
        axes.axhline(0.0, color="#555555", lw=1)
        for command in flights:
            k, lost = command.stamp, command.stamp == LOST
            label = "  ".join(f"$u_{int(u)}$" if k + j >= LEAD else "0" for j, u in enumerate(command.inputs[:, 0]))
            color = "#b3261e" if lost else "#1f5f99"
            axes.text(k, 1.1, label, ha="center", va="bottom", color=color, fontsize=9)
            end = (k + 0.5 * DELAY, 0.5) if lost else (k + DELAY, 0.03)
            if k + DELAY < STEPS or lost:
                axes.annotate("", end, (k, 0.97), arrowprops={"arrowstyle": "-|>", "color": color, "lw": 1.4})
            if lost:
                axes.plot(*end, "x", color=color, ms=11, mew=2.5)
                axes.text(end[0] + 0.12, end[1] + 0.03, "lost", color=color, va="bottom")
        for step, newest, u, missing in sources:
            assert not missing
            text = f"$u_{int(u)}$" if step >= LEAD else "0"
            axes.text(step, -0.1, text, ha="center", va="top", fontsize=12, weight="bold")
            source = "agreed" if step < LEAD else f"of command {newest}"
            second = step == LOST + DELAY
            axes.text(step, -0.32, source, ha="center", va="top", fontsize=8, color="#b3261e" if second else "#555555")
        axes.text(-0.75, 1.0, "controller\nsends", ha="right", va="center")
        axes.text(-0.75, 0.0, "actuator\napplies", ha="right", va="center")
        axes.set(xlim=(-0.7, STEPS - 0.4), ylim=(-0.5, 1.35), xticks=range(STEPS), yticks=[], xlabel="step")
        for spine in ("left", "bottom"):
            axes.spines[spine].set_visible(False)
        return figure


RECORDED = ("CartPole", "BatchReactor", "Convoy", "LaneKeeping")
SPAN, PERIOD, EPISODE = 3600.0, 0.02, 60.0
# A packet's time when a queue drains, and the shortest stall that counts [s].
SERVICE, STALL = 0.002, 0.2


class Drive(NamedTuple):
    """Stalls on a drive, in which packets wait, that then arrive in order; lengths between two have a Pareto tail."""

    stalls: float  # per hour
    shortest: float  # [s]
    longest: float
    tail: float

    @classmethod
    def of(cls, records: Sequence[tuple[np.ndarray, np.ndarray]]) -> Self:
        """Returns the fit of records, times at which packets were sent, and at which they arrived [s]."""
        lengths = np.concatenate([stalls_of(*each) for each in records])
        tail = len(lengths) / np.log(lengths / lengths.min()).sum()
        return cls(len(lengths) / hours_of(records), float(lengths.min()), float(lengths.max()), float(tail))

    def delays(self, rng: np.random.Generator, sent: np.ndarray) -> np.ndarray:
        """Returns delays of packets sent at these times [s], over `SPAN`; none is lost."""
        share = 1.0 - (self.shortest / self.longest) ** self.tail
        lengths = self.shortest * (1.0 - share * rng.random(round(2.0 * self.stalls))) ** (-1.0 / self.tail)
        ready = sent + rng.gamma(6.0, 0.0025, len(sent))
        ends = np.cumsum(lengths + rng.exponential(SPAN / self.stalls - lengths.mean(), len(lengths)))
        last = np.searchsorted(ends, sent, "right")
        ready = np.where(sent >= ends[last] - lengths[last], np.maximum(ready, ends[last]), ready)
        served = SERVICE * np.arange(len(sent))  # each packet after the one before it: a_k = max(r_k, a_k-1 + s)
        return np.maximum.accumulate(ready - served) + served - sent


def hours_of(records: Sequence[tuple[np.ndarray, np.ndarray]]) -> float:
    """Returns how long packets were sent."""
    return sum(float(sent[-1] - sent[0]) for sent, _ in records) / 3600.0


def stalls_of(sent: np.ndarray, arrived: np.ndarray) -> np.ndarray:
    """Returns the times of at least `STALL` in which nothing arrived and packets were sent as ever [s]."""
    arrived, period = np.sort(arrived), np.median(np.diff(sent))
    lengths, under_way = np.diff(arrived), np.diff(np.searchsorted(sent, arrived))
    return lengths[(lengths >= STALL) & (under_way >= lengths / (2.0 * period))]


# As `stalls` fits them.
RURAL, URBAN = Drive(1352, 0.20, 33.77, 1.00), Drive(34, 0.24, 0.43, 4.01)
ROADS = {"rural": "Rural and off-road/*.txt", "urban": "Urban road/**/*_run*.txt"}


def stalls(folder: Path = Path("CICV5G/data")) -> None:
    """Stalls in the records of drives over 5G, by road: how many an hour, how long, and the tail of their lengths.

    --folder is `data` of github.com/zxr805/CICV5G (Zhang et al. 2025, doi:10.5281/zenodo.17475688, CC BY 4.0), delays
    from a car and back of packets that were sent every 50 ms.
    """
    show = table("road", "runs", "hours", "stalls/h", "shortest [s]", "longest [s]", "tail", first=8)
    for road, pattern in ROADS.items():
        tables = (np.loadtxt(file, skiprows=1, usecols=(0, 1)) / 1000.0 for file in sorted(folder.glob(pattern)))
        records = [(each[:, 0], each[:, 1]) for each in tables]
        show(road, len(records), f"{hours_of(records):.2f}", *(f"{each:.2f}" for each in Drive.of(records)))


def wifi(rng: np.random.Generator, sent: np.ndarray) -> np.ndarray:
    """Returns delays of packets sent at these times [s], NaN for lost ones, over a Wi-Fi."""
    delays = rng.gamma(4.0, 0.002, len(sent))
    lost = rng.random(len(sent)) < 0.02
    for cluster in rng.uniform(0.0, SPAN, 12):
        for begin in cluster + np.cumsum(rng.exponential(8.0, rng.integers(1, 12))):
            end = begin + 0.06 * (1.0 + rng.pareto(1.2))
            stalled = (sent >= begin) & (sent < end)
            lost |= stalled & (rng.random(len(sent)) < 0.5)
            delays = np.where(stalled, np.maximum(delays, end - sent), delays)
    return np.where(lost, np.nan, delays)


def bursts(rng: np.random.Generator, sent: np.ndarray) -> np.ndarray:
    """Returns such delays beside an interferer with a period of ten seconds."""
    lost = rng.random(len(sent)) < np.where(sent % 10.0 < 0.3, 0.9, 0.005)
    return np.where(lost, np.nan, rng.gamma(4.0, 0.001, len(sent)))


NETWORKS: dict[str, Callable[[np.random.Generator, np.ndarray], np.ndarray]] = {
    "Wi-Fi": wifi,
    "rural": RURAL.delays,
    "urban": URBAN.delays,
    "burst": bursts,
}
FILTERS = ("none", "mpc", "mpc:20", "trusting", "trusting:20", "psf:20", "psf:tube", "project", "lookahead")
# Those that claim something.
CLAIMING = ("project", "lookahead")


# Colors and markers of the networks in the figure, apart for color-blind readers (Okabe and Ito).
MARKS = {
    "Wi-Fi": ("#0072b2", "o"),
    "rural": ("#d55e00", "s"),
    "urban": ("#cc79a7", "D"),
    "burst": ("#009e73", "^"),
}


class Measured(NamedTuple):
    """How often the box is left in so many hours, and at which share of the steps the guarantee holds."""

    ends: int
    hours: float
    ever: float

    @property
    def left(self) -> float:
        """Ends per hour."""
        return self.ends / self.hours

    @property
    def interval(self) -> tuple[float, float]:
        """Where the rate of ends per hour lies with 95 %, as of a Poisson process."""
        low = 0.5 * chi2.ppf(0.025, 2 * self.ends) if self.ends else 0.0
        return float(low) / self.hours, 0.5 * float(chi2.ppf(0.975, 2 * self.ends + 2)) / self.hours

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.left:.0f} [{low:.0f}, {high:.0f}]"


def behind(env: VectorEnv, name: str) -> VectorEnv:
    """Returns environments behind a filter."""
    if name == "none" or name in REGULATORS:
        return env
    if name in CLAIMING:
        return VectorSafetyShield(env, mode=name, on_unproved="ignore")
    inner = env.unwrapped
    assert isinstance(inner, NCSVectorEnv)
    return EstimateFilterSettings(name, certificate_for(inner.plant, inner.certificate_contract))(env)


def pushes(rng: np.random.Generator, dt: float, shape: tuple[int, ...]) -> Iterator[np.ndarray]:
    """Yields actions, shape (N, m), that push in one direction for half a second to two, then in another."""
    pushed, left = np.zeros(shape, np.float32), np.zeros(shape[0], np.int64)
    while True:
        turned = left == 0
        left = np.where(turned, rng.integers(round(0.5 / dt), round(2.0 / dt) + 1, shape[0]), left - 1)
        pushed[turned] = rng.choice([-1.0, 1.0], pushed.shape)[turned]
        yield pushed


def measured(env_id: str, network: str, name: str, count: int, hours: float) -> Measured:
    """Returns what a filter, or a controller, does over a network."""
    plant = gym.make(env_id).unwrapped
    assert isinstance(plant, NCSEnv)
    dt, rng = plant.plant.dt, np.random.default_rng(0)
    sent = PERIOD * np.arange(round(SPAN / PERIOD))
    channel = PacketLog(sent, NETWORKS[network](rng, sent)).channel(dt)
    settings = {"disturbance": "adversarial", "terminate_on_violation": True, "channel": channel}
    settings |= {"contract": plant.contract, "max_episode_steps": round(EPISODE / dt)}
    env = behind(gym.make_vec(env_id, count, **settings), name)
    observation, info = env.reset(seed=0)
    shape = env.action_space.shape
    assert shape is not None
    agent = pushes(rng, dt, shape)
    controls = None
    if name in REGULATORS:
        fallback = certificate_for(plant.plant, plant.certificate_contract).fallback
        controls = controller(name, plant, fallback, 0, tuned_weights(env_id, name.partition(":")[0]))
    ended, ever, steps = 0, 0, round(hours * 3600.0 / (dt * count))
    for _ in range(steps):
        action = next(agent) if controls is None else controls(observation, info)
        observation, _, terminated, _, info = env.step(action)
        ended += np.count_nonzero(terminated)
        ever += np.count_nonzero(info.get("shield_guaranteed", False))
    number = steps * count
    return Measured(int(ended), number * dt / 3600.0, ever / number)


def _claims_drawn(found: dict[str, dict[str, dict[str, Measured]]]) -> CaptionedFigure:
    """Returns the figure of what was measured, by environment, filter and network."""
    drawn = CaptionedFigure((8.0, 0.8 + 0.24 * sum(map(len, found.values())) + 0.5 * len(found)))
    heights = [len(filters) for filters in found.values()]
    axes = drawn.subplots(len(found), 2, squeeze=False, sharex="col", width_ratios=(3, 2), height_ratios=heights)
    handles: dict[str, Artist] = {}
    for (left, claimed), (env, filters) in zip(axes, found.items(), strict=True):
        for axis in (left, claimed):
            axis.set_yticks(range(len(filters)), filters if axis is left else [""] * len(filters))
            axis.set_ylim(len(filters) - 0.4, -0.6)
        left.set_xscale("symlog", linthresh=5.0)
        left.set_xlim(-0.6, 60000.0)
        left.set_xticks([0, 10, 100, 1000, 10000], ["0", "10", "100", "1,000", "10,000"])
        left.xaxis.set_minor_locator(NullLocator())
        left.set_title(env, loc="left")
        for row, (name, networks) in enumerate(filters.items()):
            for offset, (network, each) in zip((-0.27, -0.09, 0.09, 0.27), networks.items(), strict=True):
                color, marker = MARKS[network]
                given = {"color": color, "marker": marker, "linestyle": "", "markersize": 4.5, "clip_on": False}
                left.plot(each.interval, (row + offset, row + offset), color=color, lw=1.0)
                handles[network] = left.plot(each.left, row + offset, **given)[0]
                if name in CLAIMING:
                    claimed.plot(100.0 * each.ever, row + offset, **given)
    axes[-1][0].set_xlabel("ends of episodes per hour")
    axes[-1][1].set_xlabel("steps with a claim [%]")
    legend_below(drawn, handles)
    return drawn


def recorded(
    hours: float = 1.0,
    envs: int = 64,
    ids: Annotated[Sequence[str], some_of(RECORDED)] = RECORDED,
    filters: Annotated[Sequence[str], some_of(FILTERS)] = FILTERS,
    out: Path | None = None,
) -> None:
    """Loops over networks as records have them: how often the box is left behind filters, and what is claimed then.

    The records are made here, with a seed: "Wi-Fi" stalls in clusters, for lengths with a heavy tail; on "rural" and
    "urban" drives nothing is lost, and what waits in stalls, fitted to public records (`stalls`), drains in order; a
    "burst" of an interferer takes nine of ten packets for .3 s every ten seconds. All are replayed by their clock.

    The agent pushes in one direction for half a second to two, then in another; "mpc" and "mpc:20" are model predictive
    control of the task instead, without a margin and with one of a fifth. Disturbances are adversarial. An episode
    ends where the box is left, or after a minute. "left" counts these ends per hour of plant time, with the
    interval of a Poisson process, "ever" is the share of steps at which the guarantee holds. A dash stands for a
    filter that claims nothing. With --out a figure of it.
    """
    shares_of = "  " + "".join(f"{each:>6}" for each in NETWORKS)
    found: dict[str, dict[str, dict[str, Measured]]] = {}
    for name in ids:
        print(f"{name:14}{'left per hour [95 %]':>{19 * len(NETWORKS)}}  {'ever [%]':>{6 * len(NETWORKS)}}")
        print(f"{'':14}" + "".join(f"{each:>19}" for each in NETWORKS) + shares_of)
        of_env = found[name] = {}
        for each in filters:
            over = of_env[each] = {
                network: measured(f"ncs_gym/{name}-v0", network, each, envs, hours) for network in NETWORKS
            }
            text = "".join(f"{one!s:>19}" for one in over.values())
            shares = [f"{100.0 * one.ever:6.1f}" if each in CLAIMING else f"{'-':>6}" for one in over.values()]
            print(f"{each:14}{text}  {''.join(shares)}", flush=True)
        print()
    if out is not None:
        out.write_bytes(_claims_drawn(found).png)


# Settings of both PPO agents.
PPO_ENVS = 32
PPO_SETTINGS: dict[str, Any] = {
    "n_steps": 128,
    "batch_size": 512,
    "n_epochs": 5,
    "learning_rate": 1e-3,
    "gamma": 0.98,
    "policy_kwargs": {"net_arch": [64, 64]},
}
POLICY_STYLES = {
    "period": ("#777777", "s"),
    "forced alone": ("#222222", "x"),
    "random": ("#bb8844", "v"),
    "acknowledged": ("#2266aa", "^"),
    "slack": ("#22884d", "D"),
    "PPO requests": ("#dd6677", "o"),
    "PPO both": ("#882255", "*"),
}


def environments(env_id: str, count: int, certificate: Certificate, cost: float) -> VectorRequestActions:
    return VectorRequestActions(VectorSafetyShield(gym.make_vec(env_id, num_envs=count), certificate), cost)


def trained(env: Any, steps: int, seed: int) -> Callable[[np.ndarray], np.ndarray]:
    """Returns what PPO has learned in so many steps, a function of observations."""
    normalized = VecNormalize(SB3VecEnv(env), gamma=PPO_SETTINGS["gamma"])
    model = PPO("MlpPolicy", normalized, seed=seed, device="cpu", **PPO_SETTINGS).learn(steps)
    return lambda observations: model.predict(normalized.normalize_obs(observations), deterministic=True)[0]


def learned_requests(env_id: str, certificate: Certificate, control: Policy, cost: float, steps: int, seed: int) -> Any:
    """Returns a function that makes the policy for environments: requests by PPO, inputs by the controller."""
    env = environments(env_id, PPO_ENVS, certificate, cost)
    act = trained(RequestsOnly(Asking(env, control), env), steps, seed)

    def policy_for(env: VectorRequestActions) -> Policy:
        only = RequestsOnly(Asking(env, control), env)
        return lambda observations, info: only.complete(act(only.seen(observations, info)))

    return policy_for


def learned_both(env_id: str, certificate: Certificate, cost: float, steps: int, seed: int) -> Any:
    """Returns a function that makes the policy for environments: requests and inputs by PPO."""
    act = trained(environments(env_id, PPO_ENVS, certificate, cost), steps, seed)
    return lambda env: lambda observations, info: act(observations)


def _policies_drawn(results: dict[str, tuple[float, float, float]], env_id: str) -> CaptionedFigure:
    """Draws packets per step, mean return and its half-width of each policy, a line through those of one kind."""
    figure = CaptionedFigure((7.0, 4.2))
    axis = figure.subplots()
    for kind, (color, marker) in POLICY_STYLES.items():
        mine = {name.removeprefix(kind).strip(" ,"): point for name, point in results.items() if name.startswith(kind)}
        if mine:
            x, y, width = np.array(sorted(mine.values())).T
            line = "none" if kind.startswith("PPO") else "-"
            axis.errorbar(x, y, width, color=color, marker=marker, ls=line, lw=0.8, capsize=2, label=kind)
        for value, (packets, mean, _) in mine.items():
            text = value.partition(",")[0]
            if not text.startswith("seed"):
                place = (4, 5) if kind == "period" else (4, -11)
                axis.annotate(text, (packets, mean), place, textcoords="offset points", fontsize=7, color=color)
    label(axis, "packets per step", "return of an episode", env_id.removeprefix("ncs_gym/"))
    axis.legend(loc="lower right", fontsize=8)
    return figure


def requests(
    env: str = "ncs_gym/LaneKeepingOnRequest-v0",
    episodes: int = 400,
    cost: float = 0.1,
    steps: int = 100_000,
    seeds: int = 2,
    out: Path = Path("requests.png"),
) -> None:
    """Policies that ask for samples: return, overridden share and violations against packets per step.

    A linear-quadratic regulator behind the shield proposes the inputs, and a policy asks: in every step, every few
    steps, at random, when the newest sample is old and the last request could have arrived, when the proposed input has
    little slack, or as PPO has learned. One more PPO learns inputs and requests. Where nobody asks, the contract forces
    a request when it has to. Prints the table and the winner at the price --cost of a packet, in units of the reward,
    and draws returns against packets. --episodes are those of each policy, --steps and --seeds those of each training;
    --steps 0 leaves out PPO.
    """
    shield = SafetyShield(gym.make(env))
    single, certificate = shield.unwrapped, shield.certificate
    assert isinstance(single, NCSEnv)
    assert single.contract is not None
    weights = tuned_weights(env.replace("OnRequest", ""), "lqr+shielded")
    control = controller("lqr", single, certificate.fallback, 0, weights)
    best = best_period(single.channel, single.contract)
    rules = {"period 1": every(1), f"period {best}, the best": every(best), "forced alone": at_random(0.0)}
    rules |= {f"random {share:g}": at_random(share) for share in (0.1, 0.2, 0.4)}
    rules |= {f"acknowledged {age}": acknowledged(age) for age in (1, 2, 3, 4)}
    rules |= {f"slack {threshold:g}": slack(threshold) for threshold in (0.0, 0.1, 0.3, 0.5)}
    policies: dict[str, Callable[[VectorRequestActions], Policy]] = {
        name: lambda env, rule=rule: with_rule(Asking(env, control), rule) for name, rule in rules.items()
    }
    for seed in range(seeds if steps else 0):
        policies[f"PPO requests, seed {seed}"] = learned_requests(env, certificate, control, cost, steps, seed)
        policies[f"PPO both, seed {seed}"] = learned_both(env, certificate, cost, steps, seed)
    points, worth = {}, {}
    titles = ("packets", "forced", "return", "", "less price", "overridden", "violations", "unproved", "oldest")
    rows = [["policy", *titles]]
    for name, policy_for in policies.items():
        envs = environments(env, episodes, certificate, cost)
        inner, result = envs.unwrapped, played(envs, policy_for(envs), seed=1)
        assert isinstance(inner, NCSVectorEnv)
        mean, packets = float(result.returns.mean()), result.packets
        points[name] = packets, mean, float(1.96 * result.returns.std(ddof=1) / np.sqrt(episodes))
        worth[name] = mean - cost * packets * (inner.max_episode_steps or 0)
        row = [name, f"{packets:.3f}", f"{result.forced:.1%}", f"{mean:.1f}", f"+- {points[name][2]:.1f}"]
        row += [f"{worth[name]:.1f}", f"{result.overridden:.1%}", str(result.violations), str(result.unproved)]
        rows.append([*row, str(result.oldest)])
    print(f"{env}: {episodes} episodes of each policy, max_age = {single.contract.max_age}.")
    print(single.channel.description)
    print(f"packets per step; a packet costs {cost:g} in the column less price\n")
    print(text_table(rows))
    winner = max(worth, key=lambda name: worth[name])
    print(f"\nAt this price the winner is {winner}: {worth[winner]:.1f}.")
    out.write_bytes(_policies_drawn(points, env).png)


KINDS = ("Kalman", "set-membership", "way back", "certified", "skipped")


def count_gains(env: NCSEnv, histories: ArrivalHistories) -> Counter[str]:
    """Returns counts of which gain an estimator takes, of every update that it looks up in a graph from now on."""
    counts: Counter[str] = Counter()
    kinds: dict[int, str] = {}
    table, update = histories.table, histories.table.update

    def counted(number: int) -> tuple[np.ndarray, np.ndarray]:
        found = update(number)
        if number not in kinds:
            kinds[number] = kind_of(found[0], table.statistics(number), histories.recursion)
        counts[kinds[number]] += 1
        return found

    table.update = counted
    return counts


def kind_of(gain: np.ndarray, statistics: ErrorStatistics, recursion: ErrorRecursion) -> str:
    """Returns which of the gains one is, by computing the others anew."""
    covariance, shape, age, _ = statistics
    if np.allclose(gain, kalman_gain(recursion.plant, covariance, recursion.R), rtol=1e-9, atol=1e-12):
        return "Kalman"
    if np.array_equal(gain, recursion.sets.gain(shape)):
        return "set-membership"
    if np.array_equal(gain, recursion.sets.on_the_way_back(shape)[0]):
        return "way back"
    certified = recursion.error_set.gains
    if 1 <= age <= len(certified) and np.array_equal(gain, certified[age - 1]):
        return "certified"
    assert not gain.any()
    return "skipped"


def kalman_gain(plant: LinearPlant, covariance: np.ndarray, sensor: np.ndarray) -> np.ndarray:
    """Returns P H' (H P H' + R)^-1, shape (n, p)."""
    innovation = plant.H @ covariance @ plant.H.T + sensor
    return np.linalg.solve(innovation, plant.H @ covariance).T


def gains_taken(env_id: str, episodes: int, seed: int = 0) -> Counter[str]:
    """Returns how often each kind of gain is taken in some episodes under random actions."""
    env = ncs_env(gym.make(env_id, terminate_on_violation=False))
    histories = histories_of(env.plant, env.channel, env.error_set)
    counts = count_gains(env, histories)
    env._now.estimator = Estimator(env.plant, env.channel, histories=histories)
    env.action_space.seed(seed)
    for episode in range(episodes):
        env.reset(seed=seed + episode)
        for _ in range(gym.spec(env_id).max_episode_steps or 200):
            env.step(env.action_space.sample())
    assert env._now.estimator.histories is histories  # no history was forgotten, with it the counts
    return counts


def gains(episodes: int = 50) -> None:
    """How often the gain that the estimator takes is the Kalman gain, in each registered environment.

    The estimator takes the first of these gains with which the error stays in its certified set, or skips the sample
    (docs/shield_proof.md). Counted is every update that it makes, those of replays included.
    """
    show = table("environment", "updates", *KINDS, first=28, width=15)
    for env_id in registered_ids():
        counts = gains_taken(env_id, episodes)
        total = sum(counts.values())
        show(env_id.removeprefix("ncs_gym/"), f"{total:,}", *(f"{counts[kind] / total:.2%}" for kind in KINDS))


COMMANDS = (contracts, downlink, recorded, stalls, requests, gains)

if __name__ == "__main__":
    run(__doc__, COMMANDS)
