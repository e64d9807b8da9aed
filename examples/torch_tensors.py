"""Shows the shield on batches of PyTorch tensors: a policy learns through what is applied in place of its actions.

Takes about five seconds on one core.
"""

import numpy as np
import torch

from ncs_gym import truck_trailer
from shields import SafetyFilter, synthesize

torch.set_num_threads(1)
torch.manual_seed(0)
plant = truck_trailer(mass=4000.0)
shield = SafetyFilter(synthesize(plant), plant)


def projected(actions: torch.Tensor, estimates: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns what is applied instead of actions from -1 to 1, shape (N, m), and which of them pass, (N, 1).

    The gradient is the identity where an action passes, else zero: exact for one input. No gradient to the estimates.
    """
    actions = actions.clamp(-1.0, 1.0)
    proposals = plant.input_middle + plant.input_half * actions.detach().double().numpy()
    decided = shield.decide_many(estimates.double().numpy(), shield.certificate.Sigma, proposals)
    applied = torch.as_tensor((decided.input - plant.input_middle) / plant.input_half, dtype=actions.dtype)
    passes = torch.as_tensor(~decided.intervened)[:, None]
    return torch.where(passes, actions, applied), passes


estimates = torch.as_tensor(0.9 * shield.certificate.safe_set.sample_boundary(np.random.default_rng(0), 500))
policy = torch.nn.Linear(plant.n, plant.m, dtype=torch.float64)
optimizer = torch.optim.Adam(policy.parameters(), lr=0.05)
for step in range(101):
    applied, passes = projected(policy(estimates), estimates)
    if step % 100 == 0:
        print(f"update {step}: mean action applied {applied.mean():.2f}, {passes.sum()} of 500 pass as they are")
    optimizer.zero_grad()
    (-applied.mean()).backward()  # the policy wants full force
    optimizer.step()
