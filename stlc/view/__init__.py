"""Plots, animation, reports."""
