"""What a panel gets to draw with: the contract, theme, widgets and docks."""
