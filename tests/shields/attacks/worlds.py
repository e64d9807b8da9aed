"""What the adversary is let loose on: both shields of Gymnasium, the loop without it, and estimators alone."""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from functools import cache
from typing import Any, ClassVar
from unittest import mock

import numpy as np

from ncs_gym import Actuator, Channel, Disturbance, Ellipsoid, LinearPlant, NCSEnv, Packet
from ncs_gym.estimation.arrival_histories import histories_of
from ncs_gym.estimation.error_bound import certified_error_set
from ncs_gym.estimation.estimator import VectorEstimator
from ncs_gym.network.channel import contract_of
from shields import Certificate, silence_of
from tests.ncs_gym.envs.same_draws import holding_gain
from tests.product import safe_loop, safety_shield, vector_env, vector_shield
from tests.shields.attacks.adversary import Adversary, Between, Traffic, boundary, box_of, farthest, gauges, region_of
from tests.shields.attacks.cases import Case, box_ellipsoid

SAFE_SET, BOX, KEPT, ALL_TIMES, ERROR, AGE, LASTS = (
    "in the safe set",
    "in the box",
    "in the box in silence",
    "in the box at all times",
    "error in its ellipsoid",
    "age within the contract",
    "the guarantee lasts while the contract is kept",
)
# Episodes are begun anew after so many steps, in the middle of plans; in vectors after so many.
EPISODE, VECTOR_EPISODE = 60, 20
# What is no input; a loop puts its own in the place of it.
NO_INPUTS = (None, np.nan, "left", np.zeros(9), 10**400)


class Outcome:
    """How close each claim came to being false, and what else happened.

    Attributes:
        largest: The largest gauge of each claim while it was claimed; above 1 it was false.
        ever: The same of all steps, claimed or not.
        counts: Environment steps by what happened in them.
        lost: Reasons for which a guarantee that held ended.
    """

    def __init__(self) -> None:
        self.largest: dict[str, float] = defaultdict(float)
        self.ever: dict[str, float] = defaultdict(float)
        self.counts: Counter[str] = Counter()
        self.lost: set[str] = set()

    def see(self, claim: str, values: np.ndarray, claimed: np.ndarray) -> None:
        self.ever[claim] = max(self.ever[claim], float(values.max()))
        self.largest[claim] = max(self.largest[claim], float(values[claimed].max(initial=0.0)))


class Watch:
    """Compares what is claimed of steps with what is true of them.

    Args:
        case: What is attacked.
        mode: Of the shield or loop.
        delay: Steps from a decision to its effect.
        kept_until: Until which age of the newest sample the box is said to be kept in silence, 0 for nothing.
    """

    def __init__(self, case: Case, mode: str, delay: int, kept_until: int = 0) -> None:
        self.case, self.outcome, self.delay = case, Outcome(), delay
        self.claims_safe_set = mode != "lookahead"
        self.safe, self.box = region_of(case.certificate.safe_set), box_of(case.plant)
        counts = case.plant.between_samples is not None if case.at_all_times is None else case.at_all_times
        self.between = Between(case.plant) if counts else None
        promised = case.certificate.contract
        self.oldest = np.inf if promised is None else promised.max_age - delay
        self.states: np.ndarray | None = None
        self.ages = np.zeros(1, np.int64)
        self.held, self.trusted, self.kept_until = np.zeros(1, np.bool_), np.zeros(1, np.bool_), kept_until
        # Estimates, shapes and where an episode goes on, of the steps until they belong to the present.
        self.expected: deque[tuple[np.ndarray, np.ndarray, np.ndarray]] = deque()

    @property
    def kept(self) -> np.ndarray:
        """Where the box is said to be kept in the next step, shape (N,): as long as the newest sample is young enough.

        That counts from states that were guaranteed while the contract was kept.
        """
        return self.trusted & (self.ages < self.kept_until)

    def begin(self, states: np.ndarray, held: np.ndarray, begun: Any = True) -> None:
        """States (n, N); where they are guaranteed, and where episodes start, (N,) each."""
        self.states, self.held = states, held
        self.trusted = np.where(begun | (self.ages <= self.oldest), held, self.trusted)
        for _, _, valid in self.expected:
            valid[:] &= ~np.broadcast_to(begun, valid.shape)

    def step(
        self,
        states: np.ndarray,
        inputs: np.ndarray,
        held: np.ndarray,
        ages: np.ndarray,
        reasons: Any,
        goes_on: Any = True,
    ) -> None:
        """A step to states with inputs; `goes_on` is False where a new episode began in it."""
        outcome, goes_on = self.outcome, np.broadcast_to(goes_on, held.shape)
        lost = goes_on & self.held & ~held
        if lost.any():
            outcome.lost |= set(np.atleast_1d(reasons)[lost])
        outcome.see(LASTS, 1.0 + (np.maximum(ages, self.ages) <= self.oldest), lost)
        kept = goes_on & self.kept
        self.ages = ages
        out = self.box.gauges(states)
        outcome.see(BOX, out, held)
        if self.kept_until:
            outcome.see(KEPT, out, kept)
        levels = self.safe.gauges(states)
        if self.claims_safe_set:
            outcome.see(SAFE_SET, levels, held)
        if self.between is not None:
            claimed = goes_on & (self.held & held | kept)
            outcome.see(ALL_TIMES, self.between.gauges(self.states, inputs), claimed)
        if self.case.contract is not None:
            outcome.see(AGE, ages / self.case.contract.max_age, np.ones_like(held))
        outcome.counts["steps"] += held.size
        outcome.counts["guaranteed"] += np.count_nonzero(held)
        outcome.counts["kept in silence"] += np.count_nonzero(kept & (ages > self.oldest))
        outcome.counts["outside S"] += np.count_nonzero(held & (levels > 1.0))
        self.begin(states, held, ~goes_on)

    def compare(self, estimates: np.ndarray, shapes: np.ndarray, states: np.ndarray, alarmed: Any, first: bool) -> None:
        """Compares the estimates (n, N) that belong to these states now with what they claim, shapes (N, n, n).

        Args:
            estimates: Of the step in which a decision made now takes effect.
            shapes: Of their errors.
            states: Now.
            alarmed: Where the process or a measurement left what is assumed, and nothing is claimed.
            first: Whether they are first estimates, whose errors the adversary chose on the boundary.
        """
        self.expected.append((estimates, shapes, np.full(estimates.shape[1], not (first and self.delay == 0))))
        if len(self.expected) > self.delay:
            estimates, shapes, valid = self.expected.popleft()
            self.outcome.see(ERROR, np.where(valid, gauges(shapes, estimates - states), 0.0), valid & ~alarmed)


class Nature(Disturbance):
    """The adversary's disturbances, as environments take them."""

    vectorized: ClassVar[bool] = True
    replaces_process_noise: ClassVar[bool] = True

    def __init__(self) -> None:
        self.adversary: Adversary | None = None

    def draw(self, rng, plant, nominal_next, step, memory):
        columns = nominal_next.reshape(plant.n, -1)
        d = self.adversary.disturbances(columns, plant.nominal_disturbance.shape_matrix)
        return d.reshape(nominal_next.shape)


class SeenEnv(NCSEnv):
    """Hands the plan of every decision to the adversary, as it would to a picture."""

    def install(self, guard) -> None:
        super().install(guard)
        decide = guard.decide

        def overheard(u):
            decision = decide(u)
            if (adversary := self.disturbance.adversary) is not None and guard.filter.mode == "lookahead":
                adversary.plan = guard.stored.copy()
            return decision

        guard.decide = overheard


def starts_of(case: Case, mode: str, rng: np.random.Generator, count: int) -> np.ndarray:
    """States on the boundary of the safe set, or of a part of it; in mode "lookahead" all over the box, (n, count)."""
    plant, safe = case.plant, region_of(case.certificate.safe_set)
    scale = plant.half_widths if hasattr(safe, "rows") else np.sqrt(np.diag(case.certificate.safe_set.shape_matrix))
    starts = case.start * boundary(safe, scale, rng, count)
    if mode != "lookahead":
        return starts
    spread = rng.uniform(0.2, 0.95, count) * boundary(box_of(plant), plant.half_widths, rng, count)
    return np.where(rng.random(count) < 0.3, starts, spread)


def corners_of(plant: Any, rng: np.random.Generator, count: int | None) -> dict[str, Any]:
    """Which members of a family episodes have, as an option of `reset`: those with all parameters at their ends."""
    family = plant.remainder and plant.remainder.family
    if family is None:
        return {}
    corners = family.parameters[rng.integers(len(family.parameters), size=count)]
    return {"parameters": dict(zip(family.names, corners.T, strict=True))}


def planning(case: Case, mode: str) -> dict[str, Any]:
    """Settings of a shield or loop in this mode."""
    return {"mode": mode, "horizon": case.horizon if mode == "lookahead" else None}


def shape_inside(certificate: Certificate, plant: LinearPlant) -> np.ndarray:
    """The shape of an ellipsoid around the operating point that lies in the safe set, (n, n)."""
    S = certificate.safe_set
    if isinstance(S, Ellipsoid):
        return S.shape_matrix
    box = np.linalg.inv(plant.weight)
    return ((1.0 + S.F @ S.center) / Ellipsoid(box).support(S.F)).min() ** 2 * box


def through_shield(case: Case, mode: str, network: int, count: int | None, steps: int, seed: int) -> Outcome:
    """Attacks `SafetyShield`, or with a count `VectorSafetyShield`, around environments."""
    rng, (uplink, downlink) = np.random.default_rng(seed), case.networks[network % len(case.networks)]
    plant, certificate, nature, many = case.plant, case.certificate, Nature(), count is not None
    scale = (0.999 * case.start) ** 2
    first = box_ellipsoid(plant, 0.6) if mode == "lookahead" else Ellipsoid(scale * shape_inside(certificate, plant))
    settings: dict[str, Any] = {
        "plant": plant,
        "channel": uplink,
        "downlink": downlink,
        "contract": case.contract,
        "process": case.process,
        "disturbance": nature,
        "noise": "extreme",
        "initial_set": first,
    }
    given = planning(case, mode) | {"on_unproved": "ignore"}
    if many:
        autoreset = ("NextStep", "SameStep")[seed % 2]
        env = vector_env(count, max_episode_steps=VECTOR_EPISODE, autoreset_mode=autoreset, **settings)
        shield: Any = vector_shield(env, certificate, **given)
    else:
        env = SeenEnv(**settings)
        shield = safety_shield(env, certificate, **given)

    def column(value: Any) -> np.ndarray:
        """A value of the infos with the environment as the last axis."""
        return np.moveaxis(np.asarray(value), 0, -1) if many else np.asarray(value)[..., None]

    watch, size = Watch(case, mode, env.downlink_protocol.input_delay), count or 1
    nature.adversary = adversary = Adversary(plant, certificate, rng, size)
    outcome, counts = watch.outcome, watch.outcome.counts

    def begin(begun: Any = True, **options: Any) -> Any:
        """Starts episodes, and watches them from there."""
        if not options:
            states = starts_of(case, mode, rng, size)
            options = {"state": states.T if many else states[:, 0], **corners_of(plant, rng, count)}
        _, info = shield.reset(seed=seed if watch.states is None else None, options=options)
        watch.begin(column(info["state"]), column(info["shield_guaranteed"]), begun)
        counts["starts outside S"] += np.count_nonzero(watch.held & (watch.safe.gauges(watch.states) > 1.0))
        return info

    for step in range(steps):
        if step == 0 or (step % EPISODE == 0 and not many):
            info = begin()
        elif many and step == steps // 2:
            some = np.arange(size) % 3 == 0
            info = begin(some, reset_mask=some)
        states, errors = column(info["state"]), column(info["estimation_error"])
        shapes, estimates = np.reshape(info["error_shape"], (size, plant.n, plant.n)), column(info["estimate"])
        alarmed = column(info["assumption_violated"])
        watch.compare(estimates, shapes, states, alarmed, step % EPISODE == 0)
        adversary.begin_step(errors, shapes)
        actions = (adversary.proposals(estimates) / plant.largest_input[:, None]).astype(np.float32)
        before, episodes = info.get("shield_plan_length", 0), np.array(env.episodes)
        *_, info = shield.step(actions.T if many else actions[:, 0])
        held, ages = column(info["shield_guaranteed"]), column(info["measurement_age"])
        goes_on = env.episodes == episodes
        watch.step(column(info["state"]), column(info["input"]), held, ages, info["shield_reason"], goes_on)
        broken = ["contract_broken", "downlink_broken", *([] if case.process else ["assumption_violated"])]
        outcome.lost |= {key for key in broken if np.any(info.get(key, False))}
        planned = np.asarray(info.get("shield_plan_length", 0))
        counts["overridden"] += np.count_nonzero(info["shield_intervened"])
        counts["planned"] += np.count_nonzero(planned)
        counts["stored"] += np.count_nonzero((planned == before - 1) & goes_on)
    return outcome


def hostile_input(rng: np.random.Generator, u: np.ndarray, is_planned: bool) -> Any:
    """The input, one beyond the limits, or what is none: where a plan is stored that lets it go on."""
    if rng.random() < (0.6 if is_planned else 0.9):
        return u
    return 1.5 * u if rng.random() < 0.5 else NO_INPUTS[rng.integers(len(NO_INPUTS))]


def hostile_packets(rng: np.random.Generator, packets: list[Packet], step: int) -> list[Packet]:
    """Packets out of order and twice, and some that no one may use."""
    junk = packets[0].measurement + 9.0 if packets else None
    more = [] if junk is None else [Packet(stamp, junk, packets[0].episode) for stamp in (step + 1, 0, -3)]
    some = packets + more + packets[: rng.integers(0, 3)]
    rng.shuffle(some)
    return some


@cache
def kept_in_silence(certificate: Certificate, plant: LinearPlant) -> int | None:
    """For how many steps after the last sample the box is said to be kept; without the ways back, which take long."""
    with mock.patch("shields.silence.OUTAGES", ()):
        silence = silence_of(certificate, plant)
    return None if silence is None else silence.max_age + silence.anywhere


def through_loop(
    case: Case,
    mode: str,
    network: int,
    steps: int,
    seed: int,
    *,
    aware: bool = True,
    late: int = 0,
    is_silent: bool = False,
    has_outages: bool = False,
    more: int | None = None,
    rough: float = 1.0,
) -> Outcome:
    """Attacks `SafeLoop` beside a plant that is written out here, with worst noise and traffic of any pattern.

    Args:
        case: What is attacked; the plant's own equations move.
        mode: Of the loop.
        network: Number of the network, of which the quantizer and the contracts count.
        steps: How many.
        seed: Of everything.
        aware: Whether the loop knows of its downlink.
        late: How many steps older than promised samples may be.
        is_silent: Whether no sample arrives at all.
        has_outages: Whether now and then none arrives for up to three times as long as plans are.
        more: For how many steps more than `silence_of` says the box is said to be kept in silence.
        rough: By how much disturbances are larger than assumed.
    """
    rng, (uplink, downlink) = np.random.default_rng(seed), case.networks[network % len(case.networks)]
    plant, certificate, limits = case.plant, case.certificate, case.plant.largest_input
    max_age = None if case.contract is None else case.contract.max_age + late
    oldest = 3 if max_age is None else max_age
    delay = 0 if downlink is None else contract_of(downlink).max_age
    channel = Channel(jitter=oldest, quantization_step=uplink.quantization_step)
    behind = {"downlink": downlink} if aware else {}
    loop = safe_loop(certificate, plant, channel, on_unproved="ignore", **planning(case, mode), **behind)
    outage = 0
    kept = None if more is None else kept_in_silence(certificate, plant)
    kept_until = 0 if kept is None or more is None else kept + more
    adversary, watch = Adversary(plant, certificate, rng, 1), Watch(case, mode, loop.input_delay, kept_until)
    counts, D = watch.outcome.counts, rough**2 * plant.disturbance.shape_matrix
    N = plant.sensor_error_with(uplink.quantization_step).shape_matrix
    for step in range(steps):
        if (k := step % EPISODE) == 0:
            x = starts_of(case, mode, rng, 1)
            present = x + farthest(plant.initial_error.shape_matrix, adversary.axes)
            loop.start(present[:, 0], initial_set=x[:, 0])
            watch.begin(x, np.array([loop.guaranteed]))
            uplinks, downlinks = Traffic(oldest, max_age, 1), Traffic(delay, delay, 1)
            actuator, commands, samples = Actuator(delay, plant.m, limits), deque(maxlen=delay + 1), []
            actuator.start(loop.episode)
        estimate, shape = loop.estimate[:, None], loop.error_shape
        watch.compare(estimate, shape[None], x, np.zeros(1, np.bool_), k == 0)
        adversary.begin_step((estimate if delay == 0 else present) - x, shape)
        decision = loop.decide(hostile_input(rng, adversary.proposals(estimate)[:, 0], len(adversary.plan) > 0))
        if aware:
            commands.appendleft(loop.command())
            actuator.receive([commands[age] for age, _ in downlinks.arrivals(rng, k + 1)])
            u = actuator.apply(k)
        else:
            commands.appendleft(decision.input)
            u = commands[delay] if len(commands) > delay else np.zeros(plant.m)
        adversary.plan = decision.plan
        nominal = plant.A @ x + plant.B @ u[:, None]
        x, present = nominal + adversary.disturbances(nominal, D), plant.A @ present + plant.B @ u[:, None]
        samples = [(plant.H @ x + adversary.noise(N))[:, 0], *samples[:oldest]]
        arrived = [Packet(k + 1 - age, samples[age], loop.episode) for age, _ in uplinks.arrivals(rng, k + 1)]
        if has_outages:
            outage = max(outage - 1, 0) or (rng.random() < 0.1) * int(rng.integers(1, 3 * case.horizon))
        loop.receive([] if is_silent or outage else hostile_packets(rng, arrived, k + 1))
        watch.step(x, u[:, None], np.array([loop.guaranteed]), np.array([loop.measurement_age]), loop.reason)
        counts["overridden"] += decision.intervened
        counts["planned"] += len(decision.plan) > 0
        counts["stored"] += bool(decision.stored)
    return watch.outcome


def through_estimators(
    case: Case, network: int, count: int, steps: int, seed: int, *, rough: float = 1.0, has_outages: bool = False
) -> Any:
    """Attacks many estimators alone; returns the outcome, and the error shapes that occurred, each with its age."""
    rng, plant = np.random.default_rng(seed), case.plant
    channel = Channel(jitter=6 if case.contract is None else case.contract.max_age + 1,
                      quantization_step=case.networks[network % len(case.networks)][0].quantization_step)  # fmt: skip
    error_set = certified_error_set(plant, case.contract)
    many = VectorEstimator(plant, histories_of(plant, channel, error_set), count)
    traffic = Traffic(channel.longest_delay, None if case.contract is None else case.contract.max_age, count)
    adversary, outcome = Adversary(plant, case.certificate, rng, count), Outcome()
    N = rough**2 * plant.sensor_error_with(channel.quantization_step).shape_matrix
    error = farthest(plant.initial_error.shape_matrix, adversary.axes)
    many.begin(np.ones(count, np.bool_), error)
    x, samples, seen, outage = np.zeros((plant.n, count)), [], set(), np.zeros(count, np.int64)
    gain = plant.largest_input[:, None] * holding_gain(plant)
    for step in range(1, steps + 1):
        shapes = many.histories.table.shapes.take(many.statistics, axis=0)
        adversary.begin_step(many.mean - x, shapes)
        u = gain @ many.mean + 0.05 * rng.uniform(-1.0, 1.0, (plant.m, count)) * plant.largest_input[:, None]
        nominal = plant.A @ x + plant.B @ u
        x = nominal + adversary.disturbances(nominal, plant.disturbance.shape_matrix)
        y = plant.H @ x + adversary.noise(N)
        samples = [y, *samples[: traffic.oldest]]
        certified, arrivals = many.histories.table.certified.take(many.statistics), traffic.arrivals(rng, step)
        if has_outages:
            begins = (outage == 0) & (rng.random(count) < 0.03)
            outage = np.where(begins, rng.integers(1, 12 * traffic.oldest, count), np.maximum(outage - 1, 0))
            arrivals = [(age, arrives & (outage == 0)) for age, arrives in arrivals]
        ages = many.age.copy()
        many.advance(u, y, arrivals)
        if case.contract is not None:
            certified_now = many.histories.table.certified.take(many.statistics)
            lost = certified & ~certified_now
            outcome.see(LASTS, 1.0 + (np.maximum(ages, many.age) <= case.contract.max_age), lost)
            outcome.counts["lost"] += np.count_nonzero(lost)
            outcome.counts["certified again"] += np.count_nonzero(certified_now & ~certified)
        shapes = many.histories.table.shapes.take(many.statistics, axis=0)
        outcome.see(ERROR, gauges(shapes, many.mean - x), ~many.alarm)
        if case.contract is not None:
            outcome.see(AGE, many.age / case.contract.max_age, ~many.alarm)
        if many.alarm.any():
            outcome.lost.add("an alarm")
        seen.update(zip((shape.tobytes() for shape in shapes), many.age.tolist(), strict=True))
    return outcome, error_set, seen
