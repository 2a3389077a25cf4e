"""Candidate terms for reduced models: those of mechanics, and those that saturate.

Two pads join disc and bracket. While their contacts stick, each is a spring k and a dashpot c (pad
and contact springs in series) on the slip that a rigid rolling disc would have, s_L = x_C + r theta
below and s_U = x_Br - x_C + r theta above, positions relative to where they start. The friction
forces on the disc are F_L = -(k s_L + c s_L') and F_U = k s_U + c s_U', so that

    m x_C''       = F_U + F_L      =  k (x_Br - 2 x_C) + c (...)'
    I theta''     = -r (F_U - F_L) - c_r theta' = -r [k (x_Br + 2 r theta) + c (...)'] - c_r theta'
    m_Br x_Br''   = F_x - F_U      =  F_x - k (x_Br - x_C + r theta) - c (...)'

with c_r the rolling dashpot: the normal forces of a Voigt patch shift against the rolling. r is the
rolling radius, smaller than the disc's. Those bracketed slips are the columns of `mechanics`; they
are small differences of large positions, which is why they, and not the positions, are the columns.
`friction` adds terms that saturate under slip.
"""

from collections.abc import Mapping, Sequence

from torchsoft.reduced.ode import UNITS, Factor, Term
from torchsoft.reduced.records import KINEMATICS

Candidates = Mapping[str, Sequence[Term]]
"""Candidate terms by the state whose rate they may be part of."""


def slip(text: str, **form: float) -> tuple[Term, Term]:
    """The term of a linear combination of positions [m], and the term of its rate."""
    rates = {KINEMATICS[name]: value for name, value in form.items()}
    rate_text = text.replace("x_C", "v_C").replace("x_Br", "v_Br").replace("theta", "omega")
    return Term(text, "m", (Factor(form),)), Term(rate_text, "m/s", (Factor(rates),))


def variable(name: str) -> Term:
    """The term of a variable itself."""
    return Term(name, UNITS.get(name, name), (Factor({name: 1.0}),))


def slips(r: float) -> dict[str, tuple[Term, Term]]:
    """The slips s_L and s_U for a rolling radius r [m], their difference s_U - s_L and their sum,
    each with its rate."""
    return {
        "lower": slip("x_C + r theta", x_C=1.0, theta=r),
        "upper": slip("x_Br - x_C + r theta", x_Br=1.0, x_C=-1.0, theta=r),
        "difference": slip("x_Br - 2 x_C", x_Br=1.0, x_C=-2.0),
        "sum": slip("x_Br + 2 r theta", x_Br=1.0, theta=2 * r),
    }


def mechanics(r: float, *, alike: bool = True) -> dict[str, list[Term]]:
    """Linear candidates for x_C'', theta'' and x_Br'' with the rolling radius r [m]: for each body
    the slips of the pads that touch it and their rates, drag on its own velocity, and the control
    force.

    The two slips of the disc stand there as difference and sum if both pads act alike, as in stick,
    and one by one if not, as when one slips.
    """
    s = slips(r)
    first, second = ("difference", "sum") if alike else ("lower", "upper")
    return {
        "v_C": [*s[first], *s[second], variable("v_C")],
        "omega": [*s[second], *s[first], variable("omega")],
        "v_Br": [*s["upper"], variable("v_Br"), variable("F_x")],
    }


def friction(r: float, speed: float) -> dict[str, list[Term]]:
    """Saturating candidates tanh(s' / speed) of the slips below and above, with a small `speed`
    [m/s]."""
    lower, upper = (
        Term(f"tanh(({rate.text})/{speed:g})", "1", (Factor(rate.factors[0].form, "tanh", speed),))
        for rate in (slips(r)[side][1] for side in ("lower", "upper"))
    )
    return {"v_C": [lower, upper], "omega": [lower, upper], "v_Br": [upper]}


def joined(*libraries: Candidates) -> dict[str, list[Term]]:
    """The union of several libraries."""
    targets = dict.fromkeys(target for library in libraries for target in library)
    return {
        target: [term for library in libraries for term in library.get(target, ())]
        for target in targets
    }
