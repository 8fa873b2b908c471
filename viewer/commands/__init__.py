"""What keys, menus and the pointer ask for, and what carries it out."""
