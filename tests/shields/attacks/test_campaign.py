"""The campaign: one adversary against every claim, in every case and mode; and twins of it that it has to win.

`make test` runs a part of some cases in every mode, `make test-slow` the whole of all, by the same function. All claims
that a run makes are compared in it; whatever is false names its claim.
"""

from collections import Counter
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from shields import SafetyFilter
from shields.polytope import Polytope
from shields.runtime import safety_filter
from shields.runtime.backup_plans import plan_check
from shields.runtime.guard import OLD_SAMPLE
from shields.verification.rational_matrix import is_positive_semidefinite, rational, subtract
from tests.product import altered
from tests.shields.attacks.cases import CASES, RANDOM, case
from tests.shields.attacks.worlds import (
    AGE,
    ALL_TIMES,
    BOX,
    ERROR,
    KEPT,
    LASTS,
    SAFE_SET,
    through_estimators,
    through_loop,
    through_shield,
)

pytestmark = pytest.mark.filterwarnings(
    "ignore::ncs_gym.network.channel.UnusedPacketsWarning", "ignore::ncs_gym.BrokenContractWarning"
)

MODES = ("project", "switch", "boundary", "lookahead")
# Environments and steps behind one network in the part, and behind each of them in the whole.
SIZES = {
    "SafetyShield": ((None, 120), (None, 400)),
    "VectorSafetyShield": ((20, 30), (100, 150)),
    "SafeLoop": ((1, 150), (1, 600)),
}
# How close the part comes to every claim at least, a single environment to a share of that; the box may be far larger
# than the safe set.
CLOSE = {SAFE_SET: 0.9, BOX: 0.4, ALL_TIMES: 0.9, ERROR: 0.75, AGE: 1.0, LASTS: 0.0}
SHARE = {"SafetyShield": 0.7, "VectorSafetyShield": 1.0, "SafeLoop": 0.8}
WITH_REMAINDER = [name for name in CASES if name.endswith("with remainder")]
# Families take long to make: only tests ask for them.
LINEAR = [name for name in CASES if name not in WITH_REMAINDER]
PROMISED = [name for name in LINEAR if case(name).contract]


def attacked(name, mode, through, network, seed, is_whole=False, of=None, **world):
    """What comes of an attack on a case, or on another one `of` its kind."""
    count, steps = SIZES[through][is_whole]
    target = of or case(name)
    if through == "SafeLoop":
        return through_loop(target, mode, network, steps, seed, **world)
    return through_shield(target, mode, network, count, steps, seed)


def campaign() -> list:
    """All of case x mode x what is attacked; the part is every mode of vectors, of random plants every second, and one
    mode of the others.
    """
    rows = []
    for c, name in enumerate(CASES):
        for m, mode in enumerate(MODES):
            for t, through in enumerate(SIZES):
                if through == "SafeLoop" and name in WITH_REMAINDER:  # only the environments have their processes
                    continue
                row = name, mode, through
                every = len(MODES) if through != "VectorSafetyShield" else 2 if name in RANDOM else 1
                if (c + m + t) % every == 0:
                    rows.append(pytest.param(*row, False, id="-".join(row)))
                rows.append(pytest.param(*row, True, id="-".join((*row, "whole")), marks=pytest.mark.slow))
    return rows


@pytest.mark.cases(10)
@pytest.mark.parametrize(("name", "mode", "through", "is_whole"), campaign())
def test_nothing_that_is_claimed_is_false(name, mode, through, is_whole):
    first = [*CASES].index(name) + MODES.index(mode)
    networks = range(first, first + (len(case(name).networks) if is_whole else 1))
    outcomes = [attacked(name, mode, through, network, network, is_whole) for network in networks]
    for outcome in outcomes:
        assert not outcome.lost
        false = {claim: gauge for claim, gauge in outcome.largest.items() if gauge > 1.0}
        assert not false
        if outcome.counts["guaranteed"] == outcome.counts["steps"]:  # else starts may not have been proved at all
            far = {claim: gauge for claim, gauge in outcome.largest.items() if gauge < SHARE[through] * CLOSE[claim]}
            assert not far
    counts = sum((outcome.counts for outcome in outcomes), Counter())
    assert counts["overridden"] < counts["steps"] or counts["guaranteed"] == 0  # a single start that is not proved
    if mode != "lookahead":  # there a plan may save every proposal
        assert counts["overridden"] > 0 or through == "SafetyShield"  # which has few steps
        assert counts["guaranteed"] == counts["steps"]
    elif through == "VectorSafetyShield":
        assert min(counts["planned"], counts["stored"]) > 0
        assert counts["outside S"] > 0
        assert counts["guaranteed"] > 0.3 * counts["steps"]


@pytest.mark.cases(3)
@pytest.mark.parametrize(("count", "steps"), [(30, 50), pytest.param(200, 500, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", CASES)
def test_errors_stay_in_their_ellipsoids_and_these_in_the_certified_ones(name, count, steps):
    for network in range(len(case(name).networks) if steps > 100 else 1):
        outcome, error_set, seen = through_estimators(case(name), network, count, steps, network)
        assert not outcome.lost
        assert 0.9 < outcome.largest[ERROR] <= 1.0
        assert case(name).contract is None or outcome.largest[AGE] == 1.0
        # Shapes recur: they are compared in exact arithmetic, in the part some of all ages.
        by_age = sorted(seen, key=lambda each: each[1])
        for shape, age in by_age if steps > 100 else by_age[:: len(by_age) // 10 + 1]:
            certified = error_set.shape_at(age)
            running = np.frombuffer(shape).reshape(certified.shape)
            assert is_positive_semidefinite(subtract(rational(certified), rational(running)))


@pytest.mark.cases(1)
@pytest.mark.parametrize(
    ("name", "size"),
    [("batch reactor", 60), ("cart-pole, position and angle", 100)]
    + [
        pytest.param(name, 150, marks=pytest.mark.slow)
        for name in (*PROMISED, *WITH_REMAINDER)
        if name != "cruise of 5 %, with remainder"
    ],
)
def test_errors_that_came_back_into_certified_sets_stay_there_while_the_contract_is_kept(name, size):
    outcome, _, _ = through_estimators(case(name), 0, size, size, 7, has_outages=True)
    assert outcome.largest[ERROR] <= 1.0
    assert outcome.largest[LASTS] == 1.0  # some are lost, none of them while the contract is kept
    assert min(outcome.counts["lost"], outcome.counts["certified again"]) > 0


@pytest.mark.cases(2)
@pytest.mark.parametrize(
    ("name", "seed"),
    [
        pytest.param(name, seed, marks=[pytest.mark.slow] if seed or c % 2 else [])
        for c, name in enumerate(PROMISED)
        for seed in (0, 1, 2, 3)
    ],
)
def test_the_box_is_kept_in_silence_for_as_long_as_the_certificate_says(name, seed):
    outcome = attacked(name, MODES[seed], LOOP, seed, seed, has_outages=True, more=0)
    assert not {claim: gauge for claim, gauge in outcome.largest.items() if gauge > 1.0 and claim != AGE}
    assert outcome.counts["kept in silence"] > 0
    assert outcome.largest[KEPT] > 0.3


@contextmanager
def errors_forgotten(patch):
    """The filter takes the estimate for the state."""
    one, many = SafetyFilter.errors_of, SafetyFilter.errors_of_many
    patch.setattr(SafetyFilter, "errors_of", lambda shield, shape: one(shield, 1e-6 * shape))
    patch.setattr(SafetyFilter, "errors_of_many", lambda shield, shapes: many(shield, 1e-6 * shapes))
    yield {}


@contextmanager
def set_enlarged(patch, of, factor=1.5):
    """A certificate of a larger set, which nobody verifies; episodes start where they would in the right one."""
    S = of.certificate.safe_set
    larger = {"rows": S.rows / factor} if isinstance(S, Polytope) else {"shape_matrix": factor**2 * S.shape_matrix}
    wrong = replace(of.certificate, safe_set=replace(S, **larger))
    for check in ("require_valid", "require_computable"):
        patch.setattr(safety_filter, check, lambda *_: None)
    yield {"of": replace(of, claimed=wrong, start=of.start / factor)}


TIGHTENINGS = plan_check.tightenings


@contextmanager
def tightened_less(patch, left_out):
    """Plans are checked as if some of what may happen did not: everything, or the disturbances of some steps."""

    def less(prediction, shapes):
        known = TIGHTENINGS(prediction, shapes)
        if left_out == "everything":
            return known._replace(row_limits=np.ones_like(known.row_limits))
        step = prediction.plant.disturbance.support(prediction.rows)
        return known._replace(row_limits=known.row_limits + left_out * step)

    patch.setattr(plan_check, "tightenings", less)
    yield {}


def without_the_grid(name):
    """A case whose box is certified at the sampling instants alone, and which is judged at all times."""
    timed = case(name)
    return replace(timed, plant=altered(timed.plant, between_samples=None), at_all_times=True)


def tried(patch, defect, name, mode, through):
    """Outcomes of attacks on a case with a defect, or in a world that is worse than promised."""
    of = case(name)
    kinds = {
        "errors forgotten": lambda: errors_forgotten(patch),
        "set enlarged": lambda: set_enlarged(patch, of),
        "plans checked with nothing": lambda: tightened_less(patch, "everything"),
        "plans checked with two disturbances less": lambda: tightened_less(patch, 2),
    }
    worlds = {
        "no filter": {},
        "downlink not known": {"aware": False},
        "disturbances three times as large": {"rough": 3.0},
        "samples later than promised": {"late": 2},
        "silence for longer than is said": {"is_silent": True, "more": 60},
        "times between samples not counted": {"of": without_the_grid(name)} if "at all times" in name else {},
    }
    mode = "monitor" if defect == "no filter" else mode
    for seed in range(8):
        if defect in kinds:
            with kinds[defect]() as world:
                yield attacked(name, mode, through, seed, seed, **world)
        else:
            yield attacked(name, mode, through, seed, seed, **worlds[defect])


VECTOR, SCALAR, LOOP = "VectorSafetyShield", "SafetyShield", "SafeLoop"
PLANNED = ("cruise", "cart-pole", "batch reactor", "cart-pole, polytope", "batch reactor, polytope")
BOTH_WAYS = [name for name in CASES if name.endswith("both ways")]
AT_ALL_TIMES = [name for name in CASES if name.endswith("at all times")]
ONE_STEP = MODES[:3]


def turns(names, modes, through):
    """Each case in one of the modes."""
    return [(name, modes[c % len(modes)], through) for c, name in enumerate(names)]


def each(names, modes, through):
    return [(name, mode, through) for name in names for mode in modes]


STATE = (SAFE_SET, BOX)
# Which claims become false with which defect, where that is sought, whether it counts though the guarantee was
# withdrawn, and every how many rows are tried in the part, so that every case has a twin there.
TWINS = {
    "errors forgotten": ((SAFE_SET,), turns(CASES, ONE_STEP, VECTOR), False, 2),
    "set enlarged": (STATE, turns(CASES, ("lookahead", *ONE_STEP), VECTOR), False, 3),
    "no filter": (STATE, turns(CASES, ["monitor"], SCALAR), True, 3),
    "disturbances three times as large": (STATE, turns(LINEAR, MODES, LOOP), True, 3),
    "downlink not known": ((SAFE_SET,), each(BOTH_WAYS, ONE_STEP, LOOP), True, 1),
    "samples later than promised": ((AGE,), turns(PROMISED, MODES, LOOP), True, 3),
    # The first one keeps its box for longer than an attack lasts.
    "silence for longer than is said": ((KEPT,), turns(PROMISED[1:5], MODES, LOOP), False, 2),
    "times between samples not counted": ((ALL_TIMES,), each(AT_ALL_TIMES[:2], MODES, VECTOR), False, 1),
    "plans checked with nothing": ((BOX,), each(PLANNED, ["lookahead"], VECTOR), False, 1),
    "plans checked with two disturbances less": ((BOX,), each(PLANNED, ["lookahead"], LOOP), False, 1),
}


def twins() -> list:
    return [
        pytest.param(defect, *row, id="-".join((defect, *row)), marks=[pytest.mark.slow] if (d + k) % every else [])
        for d, (defect, (_, rows, _, every)) in enumerate(TWINS.items())
        for k, row in enumerate(rows)
    ]


@pytest.mark.cases(9)
@pytest.mark.parametrize(("defect", "name", "mode", "through"), twins())
def test_the_adversary_catches(defect, name, mode, through, monkeypatch):
    claims, _, anyway, _ = TWINS[defect]
    for outcome in tried(monkeypatch, defect, name, mode, through):
        gauges = outcome.ever if anyway else outcome.largest
        if max(gauges[claim] for claim in claims) > 1.0:
            return
    raise AssertionError(dict(gauges))


@pytest.mark.cases(1)
@pytest.mark.parametrize(("name", "rough"), [("cruise", 1.5), ("cart-pole, position and angle", 2.0)])
def test_sensor_noise_larger_than_assumed_takes_errors_out_of_their_ellipsoids(name, rough):
    outcome, _, _ = through_estimators(case(name), 0, 40, 100, 0, rough=rough)
    assert outcome.ever[ERROR] > 1.0


@pytest.mark.cases(2)
@pytest.mark.parametrize("mode", ["project", "lookahead"])
@pytest.mark.parametrize("name", ["cart-pole", "batch reactor"])
def test_broken_contract_ends_the_guarantee_before_anything_is_left(name, mode):
    outcome = attacked(name, mode, LOOP, 0, 0, is_silent=True)
    assert max(outcome.largest[claim] for claim in STATE) <= 1.0 < outcome.ever[BOX]
    assert outcome.lost == {OLD_SAMPLE}
    assert 0 < outcome.counts["guaranteed"] < outcome.counts["steps"]
