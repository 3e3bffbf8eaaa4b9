"""Kinds of plants, a file each; the file `NAME.py` reads the key `NAME` of plant files.

The modules are imported in the process of a plant, too. They import what they need (fmpy, gymnasium, a user's
file) when a plant is opened.
"""
