"""The commands of keys, menus and pointer, and how they are carried out."""
