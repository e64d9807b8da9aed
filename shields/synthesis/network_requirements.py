"""What network a plant needs: for which channels a certificate exists, and how much of the safe box it keeps.

A certificate depends on a network only through its contract (the largest age of the newest sample, and the quantization
step), so that many networks share one search.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import inf
from typing import Any, NamedTuple

from ncs_gym import Channel, ChannelContract, contract_of
from ncs_gym.network.contract import largest_age
from ncs_gym.validation import as_count, as_number
from shields.certificate import Certificate


@dataclass(frozen=True, kw_only=True)
class Network:
    """A network between sensor, controller and actuator, how often the loop samples, and what disturbs it.

    Attributes:
        sampling_period: Duration of a control step [s].
        send_period: Steps between samples.
        losses: Most packets that are lost in a row; None for any number.
        delay: Fixed delay of a sample [steps].
        jitter: Largest further delay [steps].
        input_delay: Steps from a decision until its input takes effect, as behind a downlink (docs/contracts.md).
        quantization_step: Step of the quantizer, in the units of y; 0 for none.
        disturbance: Size of the plant's disturbances, as a factor on their radii.
        noise: Size of its sensor noise and first errors, as a factor on their radii.

    Raises:
        ValueError: If a value is out of range, or the newest sample would become older than contracts can be.
    """

    sampling_period: float
    send_period: int = 1
    losses: int | None = 0
    delay: int = 0
    jitter: int = 0
    input_delay: int = 0
    quantization_step: float = 0.0
    disturbance: float = 1.0
    noise: float = 1.0

    def __post_init__(self) -> None:
        as_number(self.sampling_period, "sampling_period", low=0.0, low_open=True)
        for name in ("disturbance", "noise"):
            as_number(getattr(self, name), name, low=0.0, low_open=True)
        as_count(self.input_delay, "input_delay", low=0)
        if self.losses is not None and self.contract is None:
            raise ValueError(f"the newest sample would become older than contracts can be: {self}")

    @property
    def contract(self) -> ChannelContract | None:
        """What the network promises of the newest sample when an input takes effect; None for nothing."""
        channel = Channel(
            loss=1.0,
            quantization_step=self.quantization_step,
            send_period=self.send_period,
            delay=self.delay,
            jitter=self.jitter,
            max_consecutive_losses=self.losses,
        )
        promised = contract_of(channel)
        return promised and ChannelContract(promised.max_age + self.input_delay, promised.quantization_step)

    @property
    def setting(self) -> str:
        """In words what it says besides the age of samples: period, rounding, and sizes of what disturbs."""
        words = f"sampled every {self.sampling_period:g} s"
        if self.quantization_step:
            words += f", rounded to {self.quantization_step:g}"
        if self.disturbance != 1.0:
            words += f", disturbances times {self.disturbance:g}"
        return words if self.noise == 1.0 else f"{words}, noise times {self.noise:g}"

    @property
    def age(self) -> float:
        """The largest age of the newest sample when an input takes effect [steps]; infinite without a limit."""
        return largest_age(self.contract)

    @property
    def most_losses(self) -> float:
        """Most packets that are lost in a row, infinite without a limit."""
        return inf if self.losses is None else self.losses

    def bears(self, other: Network) -> bool:
        """Returns whether this network may lose as many packets as another one, and delay samples and inputs as long.

        Delays are compared in seconds.
        """
        late, late_inputs = (
            size(self) * self.sampling_period >= (1.0 - 1e-9) * size(other) * other.sampling_period
            for size in (lambda each: each.delay + each.jitter, lambda each: each.input_delay)
        )
        return self.most_losses >= other.most_losses and late and late_inputs

    @property
    def packets_per_second(self) -> float:
        """Samples that are sent in a second."""
        return 1.0 / (self.send_period * self.sampling_period)


@dataclass(frozen=True, eq=False, kw_only=True)
class Requirement:
    """What is known of one network.

    Attributes:
        network: The network.
        certificate: A verified certificate for it; None if none was found, which does not prove that there is none.
        searched: Whether this problem was searched itself; otherwise its answer follows from that of an easier or a
            harder one.
        tolerance: Factor on all radii for which a certificate verified, too; None if it was not sought.
        bits_per_second: Bits of measurements in a second, without headers; 64 per number that is not quantized.
    """

    network: Network
    certificate: Certificate | None
    searched: bool
    tolerance: float | None
    bits_per_second: float

    @property
    def share(self) -> float:
        """Share of the safe box that the ellipsoid in the certified set fills, 0 without a certificate.

        Where limits have two ends, that of the polytope itself. Where the box has too many corners to know its volume,
        the share of its largest ellipsoid; 1 where nothing is known, as of a box that is open.
        """
        return share_of(self.certificate)


def kind_of_share(certificate: Certificate) -> str:
    """Returns what has the share of the safe box by which certificates of a plant are compared."""
    return _kind_and_share(certificate)[0]


def share_of(certificate: Certificate | None) -> float:
    """Returns that share, 0 for no certificate."""
    return 0.0 if certificate is None else _kind_and_share(certificate)[1]


def _kind_and_share(certificate: Certificate) -> tuple[str, float]:
    known, polytope = certificate.provenance, certificate.polytope
    names = ["share_of_box", "share_of_box_at_rest", "volume_of_box_ellipsoid"]
    if polytope is not None and not certificate.keeps_ellipsoid and not polytope.is_symmetric:
        names = ["polytope_share_of_box"]
    found = next((name for name in names if name in known), None)
    if found is None:
        return "certificate", 1.0
    return "polytope" if found == "polytope_share_of_box" else "ellipsoid", float(known[found])


class LargestAge(NamedTuple):
    """How old the newest sample may become, for one sampling period, quantization step and size of what disturbs.

    Ages are those of contracts for both directions: the steps that inputs are late count, so that the newest sample may
    be so many steps less old (docs/contracts.md).

    Attributes:
        network: A network of these.
        certified: Largest age for which a certificate verified [steps]; None if there is none.
        none_found: Smallest age beyond it for which none was found [steps]; None if none was asked.
    """

    network: Network
    certified: float | None
    none_found: float | None


@dataclass(frozen=True, eq=False, kw_only=True)
class Requirements:
    """The networks that were asked about, with what certifies.

    Attributes:
        points: What is known of each network.
        largest_ages: The boundary in the age of the newest sample.
    """

    points: tuple[Requirement, ...]
    largest_ages: tuple[LargestAge, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", tuple(self.points))

    @property
    def largest_share(self) -> float:
        """The largest share of the box that any network keeps."""
        return max(point.share for point in self.points)

    def cheapest(self, keep: float = 0.9, bearing: Network | None = None) -> Requirement | None:
        """Returns the network with the fewest packets per second that keeps this fraction of the largest share.

        Among several the one with the fewest bits per second, then the one that may lose and delay most. None if
        there is none.

        Args:
            keep: Fraction of the largest share, in (0, 1].
            bearing: Only networks that may lose and delay as much as this one count; None for all.

        Raises:
            ValueError: If the fraction is not in (0, 1].
        """
        as_number(keep, "keep", low=0.0, high=1.0, low_open=True)
        least = keep * self.largest_share
        enough = [point for point in self.points if point.certificate is not None and point.share >= least]
        if bearing is not None:
            enough = [point for point in enough if point.network.bears(bearing)]

        def cost(point: Requirement) -> tuple[float, ...]:
            network = point.network
            late = network.delay + network.jitter + network.input_delay
            return network.packets_per_second, point.bits_per_second, -network.most_losses, -late

        return min(enough, key=cost, default=None)

    @property
    def document(self) -> dict[str, Any]:
        """All of it as JSON values, without the certificates."""
        return {
            "points": [
                asdict(point.network)
                | {
                    "max_age": _finite(point.network.age),
                    "possible": point.certificate is not None,
                    "searched": point.searched,
                    "share": point.share,
                    "tolerance": point.tolerance,
                    "packets_per_second": point.network.packets_per_second,
                    "bits_per_second": point.bits_per_second,
                    "certificate_sha256": point.certificate and point.certificate.checksum,
                }
                for point in self.points
            ],
            "largest_ages": [
                {
                    "sampling_period": each.network.sampling_period,
                    "quantization_step": each.network.quantization_step,
                    "disturbance": each.network.disturbance,
                    "noise": each.network.noise,
                    "certified": None if each.certified is None else _finite(each.certified),
                    "unlimited": each.certified == inf,
                    "none_found": None if each.none_found is None else _finite(each.none_found),
                }
                for each in self.largest_ages
            ],
        }


def _finite(age: float) -> int | None:
    return None if age == inf else int(age)
