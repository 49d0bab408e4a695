"""The plugin for nerfstudio 1.1.5, which finds its `entry_points`; the standalone program imports nothing here."""
