"""The local site's command, as `farhand local` and as `python -m local_site`."""

from local_site.site import build_local_site
from site_runtime.daemon import site_command
from site_runtime.keys import SiteId

local = site_command(SiteId.LOCAL, build_local_site)
