"""What makes pages of the documentation out of what runs; only `site` and `mathml` know Sphinx."""
