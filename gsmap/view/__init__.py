"""The browser page of a map, and pictures of scenes, edges and changes.

This package does not import the store. `gsmap.view.page_source` is the interface of a map, and `ViewServer` serves it
on this machine only::

    with ViewServer(page_source, cache) as server:
        print(server.url)
        server.serve_forever()
"""

from gsmap.view.content import ViewMap, ViewScene
from gsmap.view.params import Params
from gsmap.view.server import ViewServer

__all__ = ["Params", "ViewMap", "ViewScene", "ViewServer"]
