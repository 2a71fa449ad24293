"""python -m design.limits: how good could a coupling be, with another device, delay, period or order?"""
