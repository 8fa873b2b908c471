"""The means of drawing a panel: its interface, the theme, widgets and docks."""
