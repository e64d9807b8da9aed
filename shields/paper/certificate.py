"""The certificate of the published method."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ncs_gym import Ellipsoid
from ncs_gym.validation import ReadOnlyArrays, as_matrix, as_number
from shields.certificate_text import counted, table
from shields.errors import CertificateError


@dataclass(frozen=True, eq=False, kw_only=True)
class PaperCertificate(ReadOnlyArrays):
    """A set E(L) and a gain that meet the constraints of OP (Liu et al. Definition 4).

    It carries the guarantee of the paper's own definitions, which assumes e'e <= epsilon at every step. It has no error
    set, so that no shield takes it: `shields.certify(plant, L, K)` proves the same set and gain, if it can be proved.

    Attributes:
        L: Shape of the ellipsoid, (n, n) [squares of the states' units].
        K: Gain of u = K x_hat, shape (m, n) [input per state].
        kappa: Contraction factor.
        rho: Bound on the condition number of L.
        epsilon: Bound on the squared state error of Theorem 3.
        epsilon_up: Bound on the squared uplink error of Theorem 2.
        fingerprint: Fingerprint of the plant that it belongs to.
        provenance: How it was made; it proves nothing.

    Raises:
        CertificateError: If a field is of the wrong kind.
    """

    L: np.ndarray
    K: np.ndarray
    kappa: float
    rho: float
    epsilon: float
    epsilon_up: float
    fingerprint: str
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        try:
            n = len(as_matrix(self.L, (None, None), "L"))
            object.__setattr__(self, "L", as_matrix(self.L, (n, n), "L"))
            object.__setattr__(self, "K", as_matrix(self.K, (None, n), "K"))
            for name in ("kappa", "rho", "epsilon", "epsilon_up"):
                object.__setattr__(self, name, as_number(getattr(self, name), name))
        except (TypeError, ValueError) as error:
            raise CertificateError(f"not a certificate: {error}") from error
        self._make_arrays_read_only()

    @property
    def ellipsoid(self) -> Ellipsoid:
        """The ellipsoid E(L)."""
        return Ellipsoid(self.L)

    def __str__(self) -> str:
        m, n = self.K.shape
        widths = ", ".join(f"{width:.4g}" for width in np.sqrt(np.diag(self.L)))
        rows = [
            ("plant", f"{counted(n, 'state')}, {counted(m, 'input')}, fingerprint {self.fingerprint[:16]}"),
            ("set", f"x'Mx <= 1, that reaches |x_i| <= {widths}"),
            ("constants", f"kappa {self.kappa:.4g}, rho {self.rho:.4g}, epsilon {self.epsilon:.4g}"),
            ("guarantee", "the paper's own: invariance if e'e <= epsilon at every step"),
        ]
        return table("Certificate of OP and Algorithm 1 of Liu et al. (shields.paper.verify checks it)", rows)
