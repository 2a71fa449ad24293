"""Checks of `sim.suite` that ask hw: every fault of a session, and its memory over an hour."""
