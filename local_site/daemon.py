"""The local site's command, as `farhand local` and as `python -m local_site`."""

import typer

from local_site.site import build_local_site
from site_runtime.daemon import (
    Connect,
    DaemonOptions,
    Duration,
    Listen,
    Quiet,
    SessionPath,
    run_daemon,
)
from site_runtime.keys import SiteId


def local(
    session: SessionPath,
    connect: Connect = None,
    listen: Listen = None,
    duration: Duration = None,
    quiet: Quiet = False,
) -> None:
    """Run the local site until Ctrl-C."""
    options = DaemonOptions(
        None if connect is None else tuple(connect),
        None if listen is None else tuple(listen),
        duration,
        quiet,
    )
    raise typer.Exit(run_daemon(SiteId.LOCAL, build_local_site, session, options))
