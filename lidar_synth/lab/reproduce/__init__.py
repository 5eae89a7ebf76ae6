"""Tables 1 to 6 of the LiDAR-Flow paper, from the recipes to the figures."""
