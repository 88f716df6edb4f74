"""What a person sees of a data set: tables, figures and films."""
