"""neural-ssm with the sizes and the training of its benchmark runner, 200 epochs."""

import copy

import numpy as np
import torch
from given import every_u, keep, left, u, y
from neural_ssm import DeepSSM

WIDTH, STATES, EPOCHS = 16, 16, 200


def scaled(signal, mean, std):
    return torch.tensor((signal - mean) / std, dtype=torch.float32)


torch.manual_seed(0)
u_mean, u_std, y_mean, y_std = u.mean(), u.std(), y.mean(), y.std()
U, Y, cut = scaled(u, u_mean, u_std), scaled(y, y_mean, y_std), 4 * len(u) // 5
length = min(1024, cut)
washout = min(50, length // 2)
starts = [*range(0, cut - length + 1, length)]
windows = [torch.stack([s[k : k + length] for k in starts]) for s in (U, Y)]
model = DeepSSM(1, 1, d_model=WIDTH, d_state=STATES, n_layers=2, d_hidden=16, param="lru", ff="GLU")
optimizer = torch.optim.Adam(model.parameters(), lr=3e-3)
best, kept = float("inf"), copy.deepcopy(model.state_dict())
for _ in range(EPOCHS):
    if left() < 8.0:
        break
    for batch in torch.randperm(len(starts)).split(32):
        optimizer.zero_grad()
        found, _ = model(windows[0][batch], mode="scan")
        loss = (found - windows[1][batch])[:, washout:].square().mean()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
    with torch.no_grad():
        found, _ = model(U[None], mode="scan")
        error = (found[0] - Y)[cut:].square().mean().item()
    if error < best:
        best, kept = error, copy.deepcopy(model.state_dict())
model.load_state_dict(kept)
with torch.no_grad():
    simulated, _ = model(scaled(every_u, u_mean, u_std)[None], mode="scan")
keep(np.asarray(simulated[0]) * y_std + y_mean)
