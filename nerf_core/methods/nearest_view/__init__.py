"""The nearest training photo, shown as it is: the baseline that learns nothing."""
