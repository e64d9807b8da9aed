"""The verdict of both verifiers, which have no code in common: whatever tests let one judge, both do."""

from __future__ import annotations

from ncs_gym import LinearPlant
from shields import Certificate, Report, verify


def verified(certificate: Certificate, plant: LinearPlant) -> Report:
    """The report of the first engine, after the second has come to the same verdict on every condition."""
    first, second = (verify(certificate, plant, engine=engine) for engine in ("rational", "flint"))
    assert first.valid == second.valid, f"{first}\n\n{second}"
    if certificate.method == "paper":  # (C1) and (C7) are stated in other words, and (C1) needs L > 0
        one, other = broken_constraints(first), broken_constraints(second)
        assert one - other <= ({"(C1)"} if "L" in one else set()), (first, second)
        assert other <= one, (first, second)
    else:
        judged = {condition.name: condition.holds for condition in second.conditions}
        also = {name: holds for name, holds in judged.items() if name.startswith("chi-square")}
        assert {condition.name: condition.holds for condition in first.conditions} | also == judged, (first, second)
    assert all((condition.margin >= 0.0) == condition.holds for condition in second.conditions)
    return first


def broken_constraints(report: Report) -> set[str]:
    """The first words of the conditions that do not hold."""
    return {condition.name.split()[0] for condition in report.conditions if not condition.holds}
