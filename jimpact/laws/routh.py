"""Routh's incremental impulses with one energetic coefficient for the whole impact."""

import jax.numpy as jnp

from jimpact.core.contact import Contact
from jimpact.core.law import Impulses, Law, Values, parameter
from jimpact.numerics.lcp import solve_lcp
from jimpact.tools.compiling import full_precision


class Routh(Law):
    """Rigid contacts whose impulses grow in constant ratios; one e for their work.

    Equation: `p = s p_c` with `0 <= gamma_c = gamma- + W p_c  _|_  p_c >= 0`. The net
    work `-(2 s - s^2) p_c^T W p_c / 2` of all contacts is least at s = 1, the end of
    compression, and the share e^2 of it is given back (energetic restitution): s = 1 +
    e. Of unequal e_j, e^2 is the mean of e_j^2, weighted by what each contact takes up
    in compression, `-p_cj gamma_j- / 2`.

    Of contacts that approach or rest it is Moreau's law with one e, and where one
    contact hits others at rest that of Hurmuzlu and Marghitu: no dispersion. It agrees
    with `LZB` for one contact, and for contacts with kinetic angle pi/2 and one e.

    Args:
        restitution: energetic coefficient e in [0, 1], scalar or one per contact (m,).

    Status: `inadmissible_velocity` where a contact separates before the impact and is
    pressed in it; `impulse_not_unique` for redundant contacts.

    Derivatives are one-sided where a contact is about to take part. Where e of the
    impact is 0, those in each e_j are one-sided, too: `sqrt` of the contact's share of
    the work.

    Source: Brogliato, Nonsmooth Mechanics (2016), 6.4.3, on Bowling and Rodriguez;
    Routh (1897). How the increments are shared is this library's reading of it.

    >>> import jimpact as ji
    >>> three_balls = ji.Contact([[2.0, -1.0], [-1.0, 2.0]], [-1.0, 0.0])
    >>> ji.Routh(0.8).impulses(three_balls).normal.round(6).tolist()
    [1.2, 0.6]
    """

    restitution: Values = parameter(low=0.0, high=1.0)

    @full_precision
    def impulses(self, contact: Contact) -> Impulses:
        """`p = (1 + e) p_c` (m,) [N s] with the impulses p_c of compression.

        Of unequal e_j, `e^2 = sum e_j^2 W_j / sum W_j`, `W_j = p_cj max(-gamma_j-, 0)`;
        where that is 0, e is 0, with the slope `sqrt(W_j / sum W)` in each e_j.
        """
        w = contact.delassus
        gamma = contact.gap_velocity
        e = self.restitution

        # the end of compression, s = 1: 0 <= gamma_c = gamma- + W p_c  _|_  p_c >= 0
        compression = solve_lcp(w, gamma)
        p_c = compression.z

        # energetic restitution: the share e^2 of the work of compression is given back
        if e.ndim:
            work = p_c * jnp.maximum(-gamma, 0.0)  # twice that of each contact
            total = jnp.sum(work)
            share = work / jnp.where(total > 0, total, 1.0)
            square = jnp.sum(e**2 * share)  # e^2 of the whole impact
            positive = square > 0
            works = share > 0
            root = jnp.sqrt(jnp.where(works, share, 1.0))
            at_zero = jnp.sum(jnp.where(works, root * e, 0.0))  # 0, with its slopes
            e = jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), at_zero)
        return Impulses((1 + e) * p_c, None, compression.code)
