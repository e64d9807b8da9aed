"""A certificate for a plant and a contract: one of the registered environments', which are data here, or a new one."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ncs_gym import ChannelContract, Ellipsoid, LinearPlant
from shields.certificate import Certificate
from shields.polytope import Polytope

# Most syntheses are over before anybody wonders [s].
_SILENT_SECONDS = 3.0

_made: dict[tuple[str, ChannelContract | None, str | None], Certificate] = {}


def certificate_for(
    plant: LinearPlant, contract: ChannelContract | None = None, safe_set: str | None = None
) -> Certificate:
    """Returns a certificate, found or synthesized once per process, plant, contract and kind of safe set.

    Those of the registered environments come with the package. Another one takes seconds to minutes, as standard error
    says. It is not verified here.

    Args:
        plant: The plant.
        contract: Channel contract; None for none.
        safe_set: "polytope", "ellipsoid" or None; see `synthesize`.

    Raises:
        CertificateError: If the file of one that comes with the package is damaged.
        Infeasible: If none is found.
    """
    key = plant.fingerprint, contract, safe_set
    if key not in _made:
        found = certificate_of_package(plant, contract, safe_set)
        _made[key] = _synthesized(plant, contract, safe_set) if found is None else found
    return _made[key]


def certificate_of_package(
    plant: LinearPlant, contract: ChannelContract | None = None, safe_set: str | None = None
) -> Certificate | None:
    """Returns the certificate that comes with the package for a plant and a contract; None if there is none."""
    kinds = {None: Polytope, "polytope": Polytope, "ellipsoid": Ellipsoid}
    for file in sorted(Path(__file__).parent.glob("*.json")):
        if plant.fingerprint in file.read_text(encoding="utf-8"):
            certificate = Certificate.load(file)
            if certificate.contract == contract and type(certificate.safe_set) is kinds.get(safe_set):
                return certificate
    return None


def _synthesized(plant: LinearPlant, contract: ChannelContract | None, safe_set: str | None) -> Certificate:
    from shields.synthesis import synthesize  # imported here: with a certificate given no solver is needed

    with synthesis_status() as show:
        return synthesize(plant, contract=contract, safe_set=safe_set, progress=show)


@contextmanager
def synthesis_status() -> Iterator[Callable[[str], None]]:
    """Yields what shows the progress of a synthesis on standard error: a line that changes, or one line in a file."""
    from tqdm import tqdm  # only where there is something to wait for

    said = sys.stderr.isatty()
    form = "synthesis, {desc} [{elapsed}]"
    with tqdm(bar_format=form, leave=False, disable=None, delay=_SILENT_SECONDS) as line:

        def show(text: str) -> None:
            nonlocal said
            if not said:
                said = True
                print("synthesizing a certificate, which takes seconds to minutes", file=sys.stderr, flush=True)
            line.set_description_str(text, refresh=False)
            line.update(0)  # which draws, unlike the text alone, only after the delay

        yield show
