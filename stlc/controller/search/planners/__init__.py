"""Planners, one per file, named by `--method` of `stlc plan`.

A file holds `PLANNER`, a dataclass whose fields are the options of the planner, with the method `prepare` of
`stlc.controller.search.planner.Planner`; `stlc.registry.PLANNERS` finds it. Code shared by several planners
lies in files whose names begin with `_`.
"""
