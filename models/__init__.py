"""Devices and human hands as one continuous MuJoCo scene, and scenes that devices touch, without any controller."""
