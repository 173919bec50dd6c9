"""Long work: where its parts run, what they keep, how far they are."""
