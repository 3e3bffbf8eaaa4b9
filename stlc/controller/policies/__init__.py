"""Policies: plan networks and policies made from actors."""
