"""The plugin for nerfstudio 1.1.5, and the only place that imports it.

Not imported by anything of the standalone program: nerfstudio finds `entry_points` by itself.
"""
