"""The vector shield behind a downlink says step by step what scalar ones say, through broken contracts and resets."""

import numpy as np
import pytest

from ncs_gym import Channel, ChannelContract, Ellipsoid, NCSVectorEnv, truck_trailer
from ncs_gym.network.downlink import no_inputs
from shields import SafetyShield, VectorSafetyShield
from shields.runtime.guarantee import LATE_INPUT, NOT_KNOWN_INSIDE
from tests.certificates import certificate_of
from tests.ncs_gym.envs.same_draws import ScriptedEnv, scalar_versions

PLANT = truck_trailer(mass=4000.0)
UPLINK = Channel(loss=0.3, quantization_step=0.05, send_period=2, delay=2)
DOWNLINKS = {
    "broken": (Channel(loss=0.3, delay=1), ChannelContract(2)),
    "broken, c = 0": (Channel(loss=0.05), ChannelContract(0)),
    "kept": (Channel(loss=0.4, delay=1, max_consecutive_losses=1), None),
}
KEYS = "shield_guaranteed", "shield_reason", "shield_intervened", "episode_interventions", "downlink_broken"
COUNT = 6


class Follower(ScriptedEnv):
    """Begins, where it is reset, in the state of the episode that its environment of the vector has just begun."""

    def reset(self, *, seed=None, options=None):
        if options is not None:  # by `follow`
            return super().reset(seed=seed, options=options)
        self.follow(self.many, self.index)
        if np.isnan(self.many.starts[self.index]).any():
            self.start = self.initial_set
        info = self._info(no_inputs(self.plant.m), self.plant.constraint_values(self._state), arrived=False)
        return self._observation(), info


@pytest.mark.parametrize("mode", ["project", "lookahead"])
@pytest.mark.parametrize("autoreset", ["NextStep", "SameStep"])
@pytest.mark.parametrize("downlink", DOWNLINKS)
def test_scalar_and_vector_shield_agree(downlink, autoreset, mode):
    certificate, (channel, contract) = certificate_of(PLANT), DOWNLINKS[downlink]
    many = NCSVectorEnv(
        COUNT,
        plant=PLANT,
        channel=UPLINK,
        downlink=channel,
        downlink_contract=contract,
        disturbance="sphere",
        initial_set=Ellipsoid(0.98**2 * certificate.L),
        autoreset_mode=autoreset,
        max_episode_steps=17,
    )
    vector = VectorSafetyShield(many, certificate, mode)
    rng, seen = np.random.default_rng(0), set()

    def assert_same(one, infos, index):
        for key in KEYS:
            assert one[key] == infos[key][index], (key, one["shield_reason"], infos["shield_reason"][index])
        seen.add(one["shield_reason"])
        if one["shield_guaranteed"]:
            inside = one["cost"] == 0.0 if mode == "lookahead" else certificate.safe_set.gauge(one["state"]) <= 1.0
            assert inside, (one["state"], index)

    # Half of them near the boundary of S, the others up to where the box ends and beyond.
    starts = certificate.safe_set.sample_boundary(rng, COUNT) * rng.uniform(0.9, 1.02, (COUNT, 1))
    starts[::2] = rng.uniform(-1.1, 1.1, (COUNT // 2, PLANT.n)) * PLANT.half_widths
    _, infos = vector.reset(seed=0, options={"state": starts})
    singles = scalar_versions(many, Follower)
    shields = [SafetyShield(each, certificate, mode) for each in singles]
    for index, shield in enumerate(shields):
        assert_same(shield.reset()[1], infos, index)
    for step in range(60):
        if step in (20, 43):  # in the middle of episodes
            chosen = (np.arange(COUNT) % 3 == 0) | many._done
            _, infos = vector.reset(options={"reset_mask": chosen, "state": starts})
            for index in np.flatnonzero(chosen).tolist():
                assert_same(shields[index].reset()[1], infos, index)
        actions, episodes = rng.uniform(-1, 1, (COUNT, 1)), many.episodes.copy()
        many.np_random.drawn = []
        *_, infos = vector.step(actions)
        for index, (single, shield) in enumerate(zip(singles, shields, strict=True)):
            begun = many.episodes[index] != episodes[index]
            if not begun or autoreset == "SameStep":
                single.hear()
                assert_same(shield.step(actions[index])[4], infos["final_info"] if begun else infos, index)
            if begun:
                assert_same(shield.reset()[1], infos, index)
    assert {"", NOT_KNOWN_INSIDE} <= seen
    assert (LATE_INPUT in seen) == (contract is not None)
