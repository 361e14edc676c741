"""Equipment of a robot: reaction wheels, flexible appendages and slosh, as joints of its model."""
