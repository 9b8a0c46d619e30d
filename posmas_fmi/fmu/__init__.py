"""FMUs: their models, description, C sources and build; loading and calling them."""
