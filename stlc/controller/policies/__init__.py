"""Policies: networks that map a state to plans, and policies that apply an actor (state -> action)."""
