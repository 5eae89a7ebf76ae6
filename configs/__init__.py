"""Recipes: one YAML file for each published model, training run and bake.

Installed as ``lidar_synth.recipes``; ``lidar-synth recipes`` lists them, and ``lidar-synth train
NAME`` finds them by name. ``base/`` holds what several recipes share; a recipe's ``base:`` names
it, and its own values take precedence. ``models/`` holds models of several stages, each of which
runs a recipe.
"""
