"""python -m hw.faults: every fault that we could think of, with what it ends in and how soon."""
