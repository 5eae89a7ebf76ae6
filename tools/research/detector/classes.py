"""The classes that are detected."""

CLASSES = {
    "car": ("Car", "Van"),
    "pedestrian": ("Pedestrian", "Person_sitting"),
    "cyclist": ("Cyclist",),
}
"""Names of the boxes of each class; other boxes (trucks, trams) are background."""

CLASS_OF = {
    name: number for number, names in enumerate(CLASSES.values()) for name in names
}
"""From a box's name to the number of its class."""

LEAST = 5
"""Minimum number of points of a box that is trained on, or that has to be found."""
