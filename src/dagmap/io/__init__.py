"""What touches the world: disk, figures, recordings. The core never imports from here."""
