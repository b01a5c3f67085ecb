"""Policies for other people's tools, and other people's policies for pgdm.

Out: TorchScript, ONNX, safetensors, Minari; in: safetensors and Stable-Baselines3.
"""
