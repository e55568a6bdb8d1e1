"""Real rays, no time: scenes, partitions, Embree, light transport, and the ray and crossing tables."""
