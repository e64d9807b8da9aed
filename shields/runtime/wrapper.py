"""The shield as a Gymnasium wrapper of an environment, or of a vector environment: both install a guard inside."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorWrapper

from ncs_gym import BrokenContractWarning, Channel, NCSEnv, NCSVectorEnv
from ncs_gym.validation import AroundEnvironments, as_number, setting, shown, warn_caller
from shields.certificate import Certificate
from shields.packaged_certificates import certificate_for
from shields.runtime.guard import Guard
from shields.runtime.safety_filter import SafetyFilter, plan_horizon


class _Shield(RecordConstructorArgs):
    """What both shields have in common: their settings, and the guard that they install."""

    certificate: Certificate = setting("certificate", "_guard.filter.certificate")
    filter: SafetyFilter = setting("filter", "_guard.filter")
    mode: str = setting("mode", "_guard.filter.mode")
    horizon: int | None = setting("horizon", "_guard.filter.horizon")
    on_unproved: str = setting("on_unproved", "_guard.lost.on_unproved")
    channel: Channel = setting("channel", "_inner.channel")

    env: Any
    # The environment that the guard stands in, and the base class of wrappers around it.
    _inside: type[NCSEnv] | type[NCSVectorEnv]
    _wrapper: Any

    @property
    def penalty(self) -> float:
        """Subtracted from the reward per intervention; it may be changed while an agent is trained."""
        return self._guard.penalty

    @penalty.setter
    def penalty(self, value: float) -> None:
        self._guard.penalty = as_number(value, "penalty", low=0.0)
        self._saved_kwargs["penalty"] = self._guard.penalty  # for the spec

    def __init__(
        self,
        env: Any,
        certificate: Certificate | Mapping[str, Any] | str | os.PathLike[str] | None = None,
        mode: str = "project",
        penalty: float = 0.0,
        horizon: int | None = None,
        on_unproved: str = "warn",
    ) -> None:
        if isinstance(certificate, os.PathLike):
            certificate = os.fspath(certificate)
        if not (certificate is None or isinstance(certificate, Certificate | Mapping | str)):
            wanted = "a Certificate, its document or path, or None"
            raise ValueError(f"certificate must be {wanted}, got {shown(certificate)}")
        recorded = certificate.document if isinstance(certificate, Certificate) else certificate
        plan_horizon(mode, horizon)
        given = {"mode": mode, "penalty": as_number(penalty, "penalty", low=0.0), "on_unproved": on_unproved}
        given["horizon"] = None if horizon is None else int(horizon)  # a spec is JSON
        RecordConstructorArgs.__init__(self, certificate=recorded, **given)
        read = None if certificate is None else Certificate.read(certificate)
        inner = self._inner = getattr(env, "unwrapped", env)
        if not isinstance(inner, self._inside):
            raise ValueError(
                f"the shield needs an {self._inside.__name__} inside, got {type(inner).__name__}, which has no plant: "
                "ncs_gym/LinearNCS-v0 takes one of yours (plant=)"
            )
        certificate = certificate_for(inner.plant, inner.certificate_contract) if read is None else read
        judge = SafetyFilter(certificate, inner.plant, mode, horizon)
        one = isinstance(inner, NCSEnv)
        self._guard = Guard(judge, inner.downlink_protocol, on_unproved, None if one else inner.num_envs)
        self._guard.look_at([inner.channel] if one else inner.episode_channels)
        self.penalty = penalty
        if (promised := certificate.contract) is not None and inner.certificate_contract is None:
            warn_caller(
                "the certificate assumes a contract of the channel, and the environment was made without one, so that "
                f"its estimator keeps other error sets: give it contract={promised}",
                BrokenContractWarning,
            )
        self._wrapper.__init__(self, env)
        inner.install(self._guard)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts episodes; see the environment's.

        Raises:
            ValueError: If the environment inside is another one than that which the shield was made for.
            GuaranteeLostError: If x in S is not proved and that is to be raised; the episodes have begun then.
        """
        if self.env.unwrapped.guard is not self._guard:
            raise ValueError(
                "the environment is not the one that the shield was made for: wrap it in a shield of its own"
            )
        return self.env.reset(seed=seed, options=options)


class SafetyShield(_Shield, gym.Wrapper):
    """Overrides an action whenever the safe set could be left (docs/shield.md).

    The action passes unchanged if every state the estimate allows stays in S; otherwise "project" applies the closest
    input that keeps it there, "switch" (and "project" where there is none) the certified u = K x_hat. S is the
    certificate's safe set, a polytope or an ellipsoid. From a start in S the true state then stays
    in S for ever, for any policy, disturbance and channel within the assumptions; `info["shield_guaranteed"]` says
    whether they still hold as far as can be seen. `SafetyFilter` has the other modes.

    The wrapper installs a guard in the environment, where nothing comes between what is decided and what is applied:
    other wrappers may stand on either side of it, and the environment stays guarded by whatever name it is called from
    then on. If you want it without a shield, too, make another one.

    ## Info (added to the environment's, at reset too)
    | key | shape or type | unit | meaning |
    |---|---|---|---|
    | `shield_intervened` | bool | - | whether it overrode the action; in mode "monitor" whether "switch" would have |
    | `input_proposed` | `(m,)` | of the inputs | the agent's input; zeros at reset |
    | `shield_correction` | float | of the inputs | Euclidean norm of `input_committed` - `input_proposed` |
    | `shield_margin` | float | - | how far inside S the next state stays (`Decision.margin`); at reset for u = 0 |
    | `shield_guaranteed` | bool | - | whether x in S is proved now (in mode "lookahead": x in the box, to stay) |
    | `shield_reason` | str | - | why it is not; empty while it is |
    | `episode_interventions` | int | steps | number of steps of this episode with `shield_intervened` |
    | `episode_guaranteed` | float | - | share of the states of this episode, the first included, proved as now |
    | `shield_plan_length` | int | steps | in mode "lookahead" only: number of inputs stored for later steps |

    Where the plant models another process, all is proved of the process only if `plant.remainder.proved`; else it rests
    on the assumption that sampling found the largest remainder (docs/beyond_linear.md).

    Args:
        env: An `NCSEnv`, possibly wrapped.
        certificate: A certificate, its `document`, or the path of its file; None takes the one that
            `shields.certificate_for` has for the environment's plant and contract.
        mode: "project", "lookahead", "switch", "boundary" or "monitor"; see `SafetyFilter`.
        penalty: Subtracted from the environment's reward per intervention counted, >= 0.
        horizon: Longest plan of mode "lookahead", in steps; see `SafetyFilter`.
        on_unproved: What reset and step do, once per episode and reason, where x in S is not proved: "warn" with a
            `GuaranteeLostWarning`, "raise" a `GuaranteeLostError` after the step, "ignore" if you read the infos.

    Raises:
        CertificateError: If the certificate does not verify for the environment's plant.
        Infeasible: If none is given and none is found.
        ValueError: If the environment is not an `NCSEnv`, has a shield already, or a setting is wrong.
    """

    _inside, _wrapper = NCSEnv, gym.Wrapper


class VectorSafetyShield(_Shield, AroundEnvironments, VectorWrapper):
    """`SafetyShield` for an `NCSVectorEnv`: the same decisions, proof and info keys, in batches.

    Every info value has N as its first axis. A step that only resets an environment counts no intervention.
    Environments that lose the guarantee in the same step for the same reason are told of once.

    Args:
        env: An `NCSVectorEnv`, possibly wrapped.
        certificate: See `SafetyShield`.
        mode: See `SafetyShield`.
        penalty: See `SafetyShield`.
        horizon: See `SafetyShield`.
        on_unproved: See `SafetyShield`.

    Raises:
        CertificateError: If the certificate does not verify for the environment's plant.
        Infeasible: If none is given and none is found.
        ValueError: If the environment is not an `NCSVectorEnv`, has a shield already, or a setting is wrong.
    """

    _inside, _wrapper = NCSVectorEnv, VectorWrapper
