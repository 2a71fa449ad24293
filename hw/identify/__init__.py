"""python -m hw.identify: how much damping does a device guarantee?"""
