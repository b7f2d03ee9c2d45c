"""Rendering: ray caster, view sphere, cluttered scenes."""
