"""What shields, filters and loops refuse, with the words that say why: a new refusal is a new row."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from agents import LoopConfig, ShieldSettings
from ncs_gym import (
    Actuator,
    Channel,
    Ellipsoid,
    NCSEnv,
    NCSVectorEnv,
    Packet,
    UnstablePlantError,
    cart_pole,
    truck_trailer,
)
from ncs_gym.estimation.error_bound import certified_error_set
from ncs_gym.estimation.estimator import Estimator
from ncs_gym.network.downlink import Command
from shields import (
    CertificateError,
    SafeLoop,
    SafetyFilter,
    SafetyShield,
    VectorSafetyShield,
)
from shields.paper import synthesize as paper_synthesis
from shields.runtime.set_test import certified_root
from tests import arrays
from tests.certificates import certificate_of
from tests.plants import small, with_remainder
from tests.product import loop_step

CRUISE = "ncs_gym/TruckTrailerCruise-v0"
PLANT, OTHER, CART = truck_trailer(mass=4000.0), truck_trailer(), cart_pole()
CONTRACT = gym.make("ncs_gym/CartPole-v0").unwrapped.contract  # type: ignore[attr-defined]
CERTIFICATE, OF_CART = certificate_of(PLANT), certificate_of(CART, CONTRACT)
SYNC = gym.make_vec(CRUISE, num_envs=2, vectorization_mode="sync")
ASKED, KEPT = Channel(on_request=True), Channel(loss=0.2, delay=1, max_consecutive_losses=2)
THIN = np.random.default_rng(0).standard_normal((6, 6)) * 10.0 ** np.linspace(-9, 0, 6)
TWO = np.zeros(2)
KNOWN = np.zeros((5, 2)), np.tile(CERTIFICATE.Sigma, (5, 1, 1)), np.zeros((5, 1))


def scalar(*given: Any, **settings: Any) -> SafetyShield:
    """A shield in an environment of its own."""
    return SafetyShield(gym.make(CRUISE), *given, **settings)


def vector(*given: Any, **settings: Any) -> VectorSafetyShield:
    """A shield in environments of its own."""
    return VectorSafetyShield(gym.make_vec(CRUISE, num_envs=2), *given, **settings)


def loop_of(channel=None, **settings) -> SafeLoop:
    """A loop in which nothing was decided yet."""
    return SafeLoop(CERTIFICATE, PLANT, Channel() if channel is None else channel, **settings)


@cache
def safety_filter() -> SafetyFilter:
    """One that only answers."""
    return SafetyFilter(CERTIFICATE, PLANT)


def stepped(shield: Any, **options: Any) -> None:
    """Steps a shield that was not reset, or in vain."""
    if options:
        with pytest.raises(ValueError, match="option"):
            shield.reset(options=options)
    shield.step(np.zeros(shield.action_space.shape))


def acted(shield: Any, value: float) -> None:
    """Steps a shield in an episode."""
    made = shield(CERTIFICATE)
    made.reset(seed=0)
    made.step(np.full(made.action_space.shape, value))


UNPROVED = r"on_unproved must be one of \['ignore', 'warn', 'raise'\]"
NO_MODEL = "needs an NCSEnv inside, got PendulumEnv"
ALREADY = "has a shield already: leave one out"
SHIELDS = (scalar, vector)
THIRTEEN = small([[0.9, 0.1], [0.0, 0.8]], B=np.ones((2, 13)))
# What is called, the error, and words of its message.
REFUSALS: list[tuple[Callable[[], Any], type[Exception], str]] = [
    # Shields: what they wrap.
    (lambda: SafetyShield(scalar(CERTIFICATE), CERTIFICATE), ValueError, ALREADY),
    (lambda: VectorSafetyShield(vector(CERTIFICATE), CERTIFICATE), ValueError, ALREADY),
    (lambda: SafetyShield(SYNC, CERTIFICATE), ValueError, "needs an NCSEnv inside"),
    (lambda: VectorSafetyShield(SYNC, CERTIFICATE), ValueError, "needs an NCSVectorEnv inside"),
    (lambda: SafetyShield(gym.make("Pendulum-v1")), ValueError, NO_MODEL),
    # Shields: their settings.
    *[
        (partial(shield, CERTIFICATE, **{name: value}), ValueError, words)
        for shield in SHIELDS
        for name, value, words in (
            ("mode", "off", "mode must be"),
            ("penalty", -1.0, "penalty must be"),
            ("on_unproved", "log", UNPROVED),
        )
    ],
    *[
        (partial(shield, certificate), error, words)
        for shield in SHIELDS
        for certificate, error, words in (
            (7, ValueError, "certificate must be a Certificate"),
            ("missing.json", CertificateError, "cannot read certificate"),
            (certificate_of(OTHER), CertificateError, "another plant"),
            (
                replace(CERTIFICATE, safe_set=Ellipsoid(1.5 * CERTIFICATE.safe_set.shape_matrix)),
                CertificateError,
                "does not verify",
            ),
        )
    ],
    (lambda: ShieldSettings(CERTIFICATE, on_unproved="maybe"), ValueError, "on_unproved must be one of"),
    # Shields: when they are stepped.
    (lambda: stepped(SafetyShield(NCSEnv(PLANT), CERTIFICATE)), gym.error.ResetNeeded, "reset"),
    (lambda: stepped(SafetyShield(NCSEnv(PLANT), CERTIFICATE), bad=1), gym.error.ResetNeeded, "reset"),
    (lambda: stepped(VectorSafetyShield(NCSVectorEnv(2, plant=PLANT), CERTIFICATE)), gym.error.ResetNeeded, "reset"),
    *[
        (partial(acted, shield, value), ValueError, "must be finite with shape")
        for shield in SHIELDS
        for value in (np.nan, np.inf)
    ],
    (lambda: LoopConfig(env="ncs_gym/CartPol-v0"), ValueError, "is no registered environment"),
    # Filters.
    (
        lambda: SafetyFilter(replace(CERTIFICATE, safe_set=Ellipsoid(1.1 * CERTIFICATE.safe_set.shape_matrix)), PLANT),
        CertificateError,
        r"\(S\)",
    ),
    (lambda: SafetyFilter(PLANT, CERTIFICATE), ValueError, "a shield takes a Certificate"),
    (lambda: SafetyFilter(CERTIFICATE, PLANT, "project", 3), ValueError, 'horizon is for mode "lookahead"'),
    *[(partial(SafetyFilter, CERTIFICATE, PLANT, "lookahead", wrong), ValueError, "horizon") for wrong in (0, 51, 2.5)],
    (lambda: SafetyFilter(CERTIFICATE, THIRTEEN, "boundary"), ValueError, "at most 12 inputs, got 13"),
    *[
        (partial(lambda *given: safety_filter().decide_many(*given), *given), ValueError, "must be numbers of shape")
        for given in ((KNOWN[0][0], *KNOWN[1:]), (KNOWN[0], KNOWN[1][:4], KNOWN[2]), (*KNOWN[:2], KNOWN[2][:, :0]))
    ],
    (lambda: certified_root(np.ones((2, 2))), CertificateError, "too thin"),
    (lambda: certified_root(0.5 * (THIN @ THIN.T + (THIN @ THIN.T).T)), CertificateError, "too thin"),
    (lambda: paper_synthesis(with_remainder()), ValueError, "a remainder"),
    # Loops: their settings, and calls before an episode has begun.
    (lambda: SafeLoop(OF_CART, CART, CONTRACT), ValueError, "channel must be a Channel"),
    (lambda: SafeLoop(OF_CART, CART, Channel(quantization_step=0.1)), ValueError, "rounds more coarsely"),
    (lambda: loop_of(on_unproved="log"), ValueError, UNPROVED),
    (lambda: loop_of().receive(), RuntimeError, "call start"),
    (lambda: loop_of().decide(0.0), RuntimeError, "call start"),
    (lambda: loop_of().receive(), RuntimeError, "call start"),
    (lambda: Estimator(CART, KEPT), UnstablePlantError, r"error_set=certified_error_set\(plant, contract\)"),
    # What stands at the other end.
    (lambda: Actuator(1, 1, -1.0), ValueError, "u_max must be a size"),
    (
        lambda: Actuator(1, 1).receive([Command(0, np.zeros((2, 1)), 0, (True,))]),
        ValueError,
        "as many requests or none",
    ),
]


@pytest.mark.parametrize(("call", "error", "words"), REFUSALS)
def test_wrong_use_is_refused_in_a_sentence(call, error, words):
    with pytest.raises(error, match=words):
        call()


NO_PACKET, NO_ECHO = r"a packet is Packet\(stamp, measurement\)", r"an echo is what Actuator.echo says"
PACKETS = [
    *(Packet(1, np.zeros(3)), Packet(1.5, TWO), (1,), None, Packet(1, "near"), Packet("1", TWO)),
    *(Packet(1, TWO, 0.5), Packet(1, TWO, None), (1, TWO, 0, 0)),
]
# Whether something has been decided, what is called, the error, and words of its message.
OF_LOOP: list[tuple[bool, Callable[[SafeLoop], Any], type[Exception], str]] = [
    *[
        (True, partial(lambda given, loop: loop.receive(given), given), ValueError, "must be a list of Packet")
        for given in (None, Packet(1, TWO), 0.5, np.array(1.0))
    ],
    *[
        (True, partial(lambda given, loop: loop.receive([Packet(1, TWO), given]), given), ValueError, NO_PACKET)
        for given in PACKETS
    ],
    *[
        (True, partial(lambda given, loop: loop.receive(echoes=[given]), given), ValueError, NO_ECHO)
        for given in (None, 5, ("1", 0, b"", 0), (1, 0, "", 0), (1, 0))
    ],
    (True, lambda loop: loop.receive(echoes=[(1, 0, b"", 0)]), ValueError, "echo_age"),
    (False, lambda loop: loop.receive(), RuntimeError, "receive was called twice"),
    (True, lambda loop: loop.decide(0.0), RuntimeError, "decide was called twice"),
    (False, lambda loop: loop.command(), RuntimeError, "call decide before command"),
    (False, lambda loop: loop.decide(0.0, ask=True), ValueError, "on_request=True"),
    (True, lambda loop: loop.request, ValueError, "on_request=True"),
    (False, lambda loop: loop.start([0.0]), ValueError, r"x_hat0 = \(.*, .*\) must have shape"),
    (True, lambda loop: loop.start(TWO, Ellipsoid(np.eye(3))), ValueError, "initial_set must have dimension 2"),
]


@pytest.mark.parametrize(("decided", "call", "error", "words"), OF_LOOP)
def test_refused_call_of_a_loop_changes_nothing(decided, call, error, words):
    loop, twin = loop_of(), loop_of()
    for each in (loop, twin):
        each.start([0.01, 0.01])
        loop_step(each, 0.1)
        each.receive([Packet(1, [0.01, 0.01])])
        if decided:
            each.decide(0.1)
    with pytest.raises(error, match=words):
        call(loop)
    for each in (loop, twin):
        if not decided:
            each.decide(0.1)
        each.receive([Packet(2, [0.01, 0.01])])
    arrays.assert_equal(loop.estimate, twin.estimate)
    assert (loop.steps, loop.episode, loop.reason) == (twin.steps, twin.episode, twin.reason)
    assert loop.guaranteed
    assert loop.measurement_age == 0


def test_what_is_refused_elsewhere_is_taken_where_it_belongs():
    """The rows above say no for their own reasons, not for others."""
    assert SafeLoop(OF_CART, CART, KEPT).contract == CONTRACT
    Estimator(CART, KEPT, error_set=certified_error_set(CART, CONTRACT))
    assert scalar(CERTIFICATE.document).filter.mode == "project"
