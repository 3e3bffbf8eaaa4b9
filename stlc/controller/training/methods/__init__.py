"""Training methods, one per file; for example, the file `guided.py` defines `--method guided`.

In a system file, `train: {method: guided}` selects the same method. Every file defines an object `METHOD`,
an instance of a subclass of `Method` (`stlc.controller.training.method`). `stlc.registry.METHODS` finds the
files. It lists their names without loading torch, for the command line, the schema of system files and tables
of options. Code shared by several methods lies in files whose names begin with `_`. Methods of other packages
and files are found, too (`stlc.plugins`).
"""
