"""Safety filters that decide by the estimate alone, as wrappers of vector environments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper

from experiments.baselines.certainty_equivalent import CertaintyEquivalentFilter
from experiments.baselines.margins import MARGINS
from experiments.baselines.predictive import TUBE_HORIZON, PredictiveFilter
from ncs_gym import NCSVectorEnv
from shields import Certificate

# Maps estimates (N, n), proposed inputs (N, m) and where an episode has just begun (N,) to the inputs to apply, (N, m).
Rule = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]

# How each filter is made from a certificate and its plant.
_NOMINAL: dict[str, Callable[..., Rule]] = {
    "trusting": CertaintyEquivalentFilter,
    "trusting:lookahead": partial(CertaintyEquivalentFilter, mode="lookahead"),
    "psf": PredictiveFilter,
}
# Also with margins in percent of the safe set, as in "psf:10", and with a tube.
FILTERS: dict[str, Callable[..., Rule]] = {
    **_NOMINAL,
    **{f"{name}:{each}": partial(make, margin=each / 100) for name, make in _NOMINAL.items() for each in MARGINS},
    "psf:tube": partial(PredictiveFilter, horizon=TUBE_HORIZON, tube=True),
}


class EstimateFilter(VectorWrapper):
    """Applies what a filter makes of the proposed inputs, given the estimates; it proves nothing.

    The infos gain `shield_intervened`, `input_proposed` and `shield_correction` as behind a `VectorSafetyShield`, but
    no `shield_guaranteed`. A step that only resets an environment counts no intervention.

    Args:
        env: A vector environment with `estimate` in its infos.
        rule: Decides the inputs.
        penalty: Subtracted from the reward per intervention.

    Raises:
        ValueError: If the innermost environment is not an `NCSVectorEnv`.
    """

    def __init__(self, env: VectorEnv, rule: Rule, penalty: float = 0.0) -> None:
        super().__init__(env)
        inner = _environment_behind(env)
        self._limits, self._inputs_of, self._rule, self.penalty = inner.plant.u_max, inner.inputs_of, rule, penalty
        self._begins_at_once = inner.autoreset_mode is AutoresetMode.SAME_STEP
        self._begins_next = inner.autoreset_mode is AutoresetMode.NEXT_STEP
        self._done = self._begun = np.zeros(self.num_envs, np.bool_)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts episodes; see `NCSVectorEnv.reset`."""
        observation, info = self.env.reset(seed=seed, options=options)
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, np.bool_)))
        self._done, self._begun = self._done & ~mask, self._begun | mask
        self._estimates = info["estimate"].copy()
        nothing = np.zeros((self.num_envs, len(self._limits)))
        return observation, info | _info(nothing, nothing, self._done & False)

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Steps the environments with the filtered actions.

        Raises:
            ValueError: If an action is not finite or the shape is wrong.
        """
        proposed = self._inputs_of(actions).T.copy()
        applied = self._rule(self._estimates, proposed, self._begun)
        intervened = (applied != proposed).any(axis=1) & ~self._done
        actions = np.array(actions, np.float64)
        actions[intervened] = applied[intervened] / self._limits
        observation, rewards, terminated, truncated, info = self.env.step(actions)
        self._estimates = info["estimate"].copy()
        applied = np.where(intervened[:, None], applied, proposed)
        ended = terminated | truncated
        self._begun, self._done = ended if self._begins_at_once else self._done, ended & self._begins_next
        info = info | _info(applied, proposed, intervened)
        return observation, rewards - self.penalty * intervened, terminated, truncated, info


@dataclass(frozen=True)
class EstimateFilterSettings:
    """Settings of a filter around a vector environment, which calling it puts there (`LoopConfig.filter`).

    Attributes:
        name: A name in `FILTERS`.
        certificate: Certificate of the safe set; it is verified when the filter is built.
        penalty: Subtracted from the reward per intervention.
        horizon: Longest plan [steps], for a filter that plans; None for its default.
    """

    name: str
    certificate: Certificate
    penalty: float = 0.0
    horizon: int | None = None

    def __call__(self, env: VectorEnv) -> EstimateFilter:
        """Returns the environment behind the filter.

        Raises:
            ValueError: If its innermost environment is not an `NCSVectorEnv`.
            CertificateError: If the certificate does not verify for the environment's plant.
        """
        given = {} if self.horizon is None else {"horizon": self.horizon}
        rule = FILTERS[self.name](self.certificate, _environment_behind(env).plant, **given)
        return EstimateFilter(env, rule, self.penalty)


def _environment_behind(env: VectorEnv) -> NCSVectorEnv:
    """Returns the innermost environment.

    Raises:
        ValueError: If it is not an `NCSVectorEnv`.
    """
    inner = env.unwrapped
    if not isinstance(inner, NCSVectorEnv):
        raise ValueError(f"a filter by the estimate needs an NCSVectorEnv inside, got {type(inner).__name__}")
    return inner


def _info(applied: np.ndarray, proposed: np.ndarray, intervened: np.ndarray) -> dict[str, Any]:
    """Returns the filter's keys, new arrays."""
    return {
        "shield_intervened": intervened.copy(),
        "input_proposed": proposed.copy(),
        "shield_correction": np.linalg.norm(applied - proposed, axis=1),
    }
