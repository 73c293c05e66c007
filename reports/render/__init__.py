"""Numbers become tables, figures and diagrams. Nothing is computed about arms here."""
