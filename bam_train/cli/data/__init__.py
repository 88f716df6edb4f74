"""Programs about data sets."""
