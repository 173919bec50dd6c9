"""One step of a real simulator, recorded on scalars, differentiated, and printed as source for compiled loops."""
