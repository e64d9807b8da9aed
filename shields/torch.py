"""The projection of mode "project" as a layer of a PyTorch model; nothing else in `shields` imports torch."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.linalg import null_space
from torch import nn

from ncs_gym import LinearPlant
from shields.certificate import Certificate
from shields.runtime.safety_filter import SafetyFilter

# A constraint counts as attained by the closest input within this much, relative to what it bounds.
ATTAINED = 1e-9


class SafeLayer(nn.Module):
    """Maps actions to those that the shield would apply, for batches of tensors, with exact gradients.

    The output is the input of `SafetyFilter.decide_many` in mode "project", in units of the limits. Its derivative with
    respect to the actions is that of the projection: the identity where an action passes; for one input zero where it
    is moved to the end of the interval; for several what the active limits, rows of the polytope and the tangent of the
    ellipsoid leave free (implicit differentiation of the conditions of Karush, Kuhn and Tucker). Where K x_hat takes
    the action's place it is zero. Where constraints meet it is that of one side. No gradient flows to estimates.

    For policies that are trained through the shield and critics that are asked about projected actions. It takes the
    place of no shield: keep one around the environment.

    Args:
        certificate: Verified exactly here.
        plant: The plant it was made for.
        error_shape: Sigma, shape (n, n), for calls without error shapes; by default the certificate's largest.

    Attributes:
        filter: What decides.

    Raises:
        CertificateError: If the certificate does not verify for the plant.
        ValueError: If the error shape is no positive semidefinite matrix.
    """

    def __init__(self, certificate: Certificate, plant: LinearPlant, error_shape: Any = None) -> None:
        super().__init__()
        self.filter = SafetyFilter(certificate, plant)
        self._shape = np.array(certificate.Sigma if error_shape is None else error_shape, dtype=np.float64)
        if not np.isfinite(self.filter.errors_of(self._shape).radius):
            raise ValueError(f"error_shape must be positive semidefinite, shape ({plant.n}, {plant.n})")

    def __deepcopy__(self, memo: dict[int, Any]) -> SafeLayer:
        return self  # nothing in it is learned

    def forward(
        self, actions: torch.Tensor, estimates: torch.Tensor, error_shapes: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Returns the actions that are applied, shape (N, m), on the device of those given and of their type.

        Of types that round more coarsely than float32, as under `torch.autocast`, they are float32: rounding to that is
        inside the margins and proofs, coarser rounding is not.

        Args:
            actions: Shape (N, m), in units of the limits; clipped to [-1, 1] first.
            estimates: x_hat, shape (N, n) [physical units]; not of a type coarser than float32.
            error_shapes: Sigma_k, shape (N, n, n), or (n, n) for all; None for that of the layer. As fine.

        Raises:
            ValueError: If the actions are no tensor of floats, a shape or a type is wrong, or a number is NaN or
                infinite: the shield would apply K x_hat, and the model learn nothing of its mistake.
        """
        if torch.jit.is_tracing():  # pyright: ignore[reportPrivateImportUsage]
            raise ValueError("a trace would keep one decision for ever: torch.jit.trace cannot hold a SafeLayer")
        if not isinstance(actions, torch.Tensor) or not actions.is_floating_point():
            got = f"one of {actions.dtype}" if isinstance(actions, torch.Tensor) else type(actions).__name__
            raise ValueError(f"actions must be a tensor of floats, shape (N, {self.filter.plant.m}), got {got}")
        actions = actions.float() if _is_coarse(actions) else actions
        given = {"actions": actions, "estimates": estimates}
        given |= {"error_shapes": self._shape if error_shapes is None else error_shapes}
        numbers = {name: _numbers(value, name) for name, value in given.items()}
        n, m = self.filter.plant.n, self.filter.plant.m
        count = len(numbers["actions"]) if actions.ndim else 0
        fitting = {"actions": [(count, m)], "estimates": [(count, n)], "error_shapes": [(n, n), (count, n, n)]}
        for name, array in numbers.items():
            if array.shape not in fitting[name]:
                wanted = " or ".join(map(str, fitting[name]))
                raise ValueError(f"{name} must have shape {wanted} beside {count} actions, got {array.shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"{name} must be finite numbers, got NaN or infinity")
        safe: torch.Tensor = _Projected.apply(  # pyright: ignore
            actions.clamp(-1.0, 1.0), self.filter, numbers["estimates"], numbers["error_shapes"]
        )
        return safe


class _Projected(torch.autograd.Function):
    """The decisions of a filter, and the derivative of what is projected."""

    @staticmethod
    def forward(ctx: Any, actions: torch.Tensor, shield: SafetyFilter, estimates: Any, shapes: Any) -> torch.Tensor:
        middle, half, numbers = shield.plant.input_middle, shield.plant.input_half, _numbers(actions, "actions")
        proposals = half * numbers + middle
        decided = shield.decide_many(estimates, shapes, proposals)
        safe = np.where(decided.intervened[:, None], (decided.input - middle) / half, numbers)
        jacobians = decided.passed[:, None, None] * np.eye(len(half))
        moved = np.flatnonzero(decided.passed & decided.intervened)
        if moved.size and ctx.needs_input_grad[0]:
            chosen = shapes if shapes.ndim == 2 else shapes[moved]
            jacobians[moved] = projection_jacobians(shield, estimates[moved], chosen, proposals[moved])
        ctx.save_for_backward(torch.as_tensor(jacobians, dtype=actions.dtype, device=actions.device))
        return torch.as_tensor(safe, dtype=actions.dtype, device=actions.device)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None, None, None]:
        (jacobians,) = ctx.saved_tensors
        # No product of matrices, which autocast would round.
        return (gradients[0][:, :, None] * jacobians).sum(dim=1), None, None, None


def projection_jacobians(
    shield: SafetyFilter, estimates: np.ndarray, error_shapes: np.ndarray, proposals: np.ndarray
) -> np.ndarray:
    """Returns the derivatives of projected actions with respect to proposed ones, in units of the limits, (N, m, m).

    For inputs that do not pass and have a closest one that does. With the active linear constraints a u = b the
    projection moves in their null space only, spanned by the columns of V. If it lies on |o + E u| = r with multiplier
    t, and q = E'(o + E u), then V'(I + t E'E) V dz + V'q dt = V'dw and q'V dz = 0, du = V dz, where w is the proposal.
    Of several inputs on an ellipsoid and a grid the shield alternates projections; this is then what the constraints
    that hold at the end leave free.

    Args:
        shield: In mode "project".
        estimates: Shape (N, n).
        error_shapes: Shape (N, n, n) or (n, n).
        proposals: Shape (N, m) [physical units].
    """
    plant, count, m = shield.plant, len(estimates), shield.plant.m
    found = np.zeros((count, m, m))
    if m == 1:  # it is moved to an end of the interval
        return found
    errors = shield.errors_of_many(np.broadcast_to(error_shapes, (count, *error_shapes.shape[-2:])))
    sets = shield.test.reachable(np.array(estimates.T, order="C"), errors)
    wanted = np.array(proposals.T, order="C")
    closest = sets.closest(wanted, shield.projection_margin)
    test, cone = shield.test, shield.test.cone
    offset = test.state_rows @ sets.estimates
    effect, row_limits = test.input_rows, sets.row_limits - sets.rounding - shield.projection_margin
    for e in range(count):
        u = closest[:, e]
        held = np.abs(u - plant.input_middle) >= (1.0 - ATTAINED) * plant.input_half
        active, ball = np.eye(m)[held], None
        reached, weighting = offset[:, e] + effect @ u, sets.weighting[..., e]
        center, radius = weighting @ reached[:cone], float(sets.radius[e]) - shield.projection_margin
        if cone and np.sqrt(center @ center) >= (1.0 - ATTAINED) * radius:
            pushed = weighting @ effect[:cone]
            ball = pushed, pushed.T @ center
        taken = np.abs(reached[cone:] - test.middle)
        attained = taken >= row_limits[:, e] - ATTAINED * np.maximum(row_limits[:, e], 1e-3)
        active = np.vstack([active, effect[cone:][attained]])
        free = np.eye(m)
        if len(active):
            free = null_space(active / np.linalg.norm(active, axis=1, keepdims=True), rcond=1e-9)
        found[e] = _jacobian(free, ball, wanted[:, e] - u)
    return found * plant.input_half / plant.input_half[:, None]  # of actions, in units of half the range


def _jacobian(free: np.ndarray, ball: tuple[np.ndarray, np.ndarray] | None, moved: np.ndarray) -> np.ndarray:
    """Returns the derivative of one projection, (m, m), given the null space V and, on the ellipsoid, E and q."""
    if ball is None or not free.size:
        return free @ free.T
    effect, normal = ball[0] @ free, free.T @ ball[1]
    square = float(normal @ normal)
    if square == 0.0:
        return free @ free.T
    multiplier = max(float(normal @ (free.T @ moved)) / square, 0.0)
    inverse = np.linalg.inv(np.eye(free.shape[1]) + multiplier * effect.T @ effect)
    along = inverse @ normal
    return free @ (inverse - np.outer(along, along) / float(normal @ along)) @ free.T


def _is_coarse(value: Any) -> bool:
    """Returns whether a tensor or an array is of a floating-point type that rounds more coarsely than float32."""
    dtype = getattr(value, "dtype", None)
    is_float = dtype.is_floating_point if isinstance(dtype, torch.dtype) else getattr(dtype, "kind", "") == "f"
    return is_float and getattr(dtype, "itemsize", 8) < 4


def _numbers(value: Any, name: str) -> np.ndarray:
    """Returns the numbers of a tensor or of nested lists; raises ValueError if they are none, or coarsely rounded."""
    if _is_coarse(value):
        raise ValueError(
            f"{name} must be float32 or float64, got {value.dtype}: no error set holds what that rounds off"
        )
    if isinstance(value, torch.Tensor) and value.layout != torch.strided:
        raise ValueError(f"{name} must be a dense tensor, got one of {value.layout}: call to_dense()")
    try:
        array = np.asarray(value.detach().cpu().resolve_neg() if isinstance(value, torch.Tensor) else value)
        if array.dtype.kind != "c":
            return array.astype(np.float64, copy=False)
    except (TypeError, ValueError, RuntimeError) as error:  # the last is torch's, of a tensor without numbers
        holds = "what torch.func and torch.export transform, and the meta device, have no numbers to decide about"
        raise ValueError(f"{name} must be numbers, got {type(value).__name__}: {error} ({holds})") from error
    raise ValueError(f"{name} must be real numbers, got {array.dtype}")
