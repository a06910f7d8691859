"""From a linear model to a fitted one: starts, training, several starts, sizes."""
