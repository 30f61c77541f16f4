"""One file per way of merging.

Each holds ``Params`` (frozen, all defaults), ``reach_m(params)`` (how far beyond a tile it must read) and
``merge(parts, params, bounds, budget_s, progress) -> MergeResult``, whose result covers at least ``bounds``.
"""
