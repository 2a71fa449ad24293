"""The gains K and B of spring-dampers: convex sets, local searches, maps. design.spring_damper is their front."""
