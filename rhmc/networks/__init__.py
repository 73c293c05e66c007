"""Networks over observations, output heads, and sampling. No losses."""
