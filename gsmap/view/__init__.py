"""A page in the browser that shows a map: splats of all placed scenes, their graphs, cameras, poses and edges.

Nothing here knows the store: `ViewMap` says what there is and how to load it, `ViewServer` serves it on this machine
only::

    with ViewServer(ViewMap("site", scenes, edges)) as server:
        print(server.url)
        server.serve_forever()
"""

from gsmap.view.content import ViewEdge, ViewMap, ViewScene
from gsmap.view.server import ViewServer

__all__ = ["ViewEdge", "ViewMap", "ViewScene", "ViewServer"]
