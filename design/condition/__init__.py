"""What a condition asks of the devices at each frequency. design.margin has the supremum, the required damping."""
