"""Real devices over a serial link, and an emulator that stands in for one. Nobody imports this world."""
