"""Hungarian: a coordinator for rhmc that assigns by distance and does not learn."""
