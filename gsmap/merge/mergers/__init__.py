"""One file per way of merging.

Each holds ``Params`` (frozen, all defaults), ``reach_m(params)`` (how far beyond a tile's border a scene's
Gaussians decide what is in it), where it reads more than that ``reading_m(params)``, and
``merge(parts, params, bounds, budget_s, progress) -> MergeResult``, whose result covers at least ``bounds``.
"""
