"""`ncs synthesize`: makes a certificate for an environment's plant."""

from __future__ import annotations

from tqdm import tqdm

import shields
from experiments.runs.experiment_setup import registered_env
from experiments.settings import SynthesizeSettings
from ncs_gym import ChannelContract


def synthesize(settings: SynthesizeSettings) -> None:
    """Runs `ncs synthesize`.

    Raises:
        ValueError: If the environment is unknown.
        Infeasible: If no certificate is found.
        OSError: If the file cannot be written.
    """
    env = registered_env(settings.env)
    plant, contract = env.plant, env.contract
    if settings.max_age is not None:
        contract = ChannelContract(settings.max_age, contract.quantization_step if contract else 0.0)
    with tqdm(bar_format="{desc} [{elapsed}]", desc="synthesis", leave=False, disable=None) as line:
        certificate = shields.synthesize(plant, settings.method, contract=contract, progress=line.set_description_str)
    certificate.save(settings.out)
    print(shields.verify(certificate, plant))
    if certificate.method == "paper":
        also = "hold" if certificate.provenance["exact_conditions_hold"] else "were not shown to hold"
        print(f"guarantee: {certificate.provenance['guarantee']}; our exact conditions {also} for it too")
    print(f"valid; saved to {settings.out}")
