function [w, J] = static_map(m, z)
% w = f(z) and J = dw/dz.
v = m.Wz * z + m.bz;
h = {{ map.sigma.matlab[0] }};
w = m.Ww * h + m.bw;
if nargout > 1
    slope = {{ map.sigma.matlab[1] }};
    J = m.Ww * (repmat(slope, 1, {{ nz }}) .* m.Wz);
end
end
