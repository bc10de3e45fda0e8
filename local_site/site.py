"""The local site of a session."""

from local_site.controller import LocalController
from local_site.operators import build_operator
from site_runtime.assembly import Surroundings, assemble
from site_runtime.keys import SiteId
from site_runtime.parts import coupling_of, damping_of
from site_runtime.session import Session
from site_runtime.site import Site


def build_local_site(session: Session, surroundings: Surroundings) -> Site:
    """Build the operator's side."""
    return assemble(
        session,
        SiteId.LOCAL,
        surroundings,
        LocalController(
            coupling=coupling_of(session.coupling),
            damping=damping_of(session.local.damping),
        ),
        build_operator(session.local.operator, session.task.dimension),
    )
