"""Numbers become tables, figures and diagrams; nothing is computed about arms here."""
