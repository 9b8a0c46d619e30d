"""The liquid-cooling domain: line physics, mapping to model (1), loads, limits, key figures."""
