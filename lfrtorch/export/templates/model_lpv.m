function [A, B, C, D, p] = {{ name }}_lpv(x, u)
% {{ NAME }}_LPV  The exact LPV form of {{ name }}, in physical units.
%
%   [A, B, C, D, p] = {{ name }}_lpv(x, u) gives the matrices with which, not approximately,
%
%       x_next = x_next0 + A (x - x0) + B (u - u0)
%       y      = y0      + C (x - x0) + D (u - u0)
%
%   They are A(:,:,1) + p(1) A(:,:,2) + p(2) A(:,:,3) + .., with the arrays and points of the struct
%   lpv in {{ name }}.mat; a row of lpv.bounds has the least and the largest value of one p.
{% if schedule == "neurons" %}
%   p(i) is the mean slope of neuron i between its values at x0, u0 and at x, u.
{% elif nw %}
%   p are the entries of Delta, by rows: w - w0 = Delta (z - z0).
{% else %}
%   There is no p: the model is linear.
{% endif %}

persistent m f
if isempty(m)
    m = {{ name }}_numbers();
    found = load(fullfile(fileparts(mfilename('fullpath')), '{{ name }}.mat'));
    f = found.lpv;
end
if numel(x) ~= {{ nx }} || numel(u) ~= {{ nu }}
    error('{{ name }}:size', '{{ name }} takes x of {{ nx }} and u of {{ nu }} numbers; these have %d and %d.', ...
        numel(x), numel(u));
end
{% if nw %}
d = f.Cz * (x(:) - f.x0) + f.Dzu * (u(:) - f.u0); % z - z0
z = m.Cz * f.x0 + m.Dzu * (f.u0 - m.u_offset); % z0
{% if schedule == "neurons" %}
p = mean_slope(m.Wz * z + m.bz, m.Wz * d);
{% else %}
% The mean of the slope between z0 and z, by a Gauss-Legendre rule that is exact.
Delta = zeros({{ nw }}, {{ nz }});
for n = 1:numel(f.nodes)
    [~, J] = static_map(m, z + f.nodes(n) * d);
    Delta = Delta + f.weights(n) * J;
end
p = reshape(Delta.', [], 1);
{% endif %}
A = at(f.A, p);
B = at(f.B, p);
C = at(f.C, p);
D = at(f.D, p);
end

function M = at(Ms, p)
M = reshape(reshape(Ms, [], numel(p) + 1) * [1; p], size(Ms, 1), size(Ms, 2));
end

{% if schedule == "neurons" %}
function s = mean_slope(v, d)
% (sigma(v + d) - sigma(v)) / d without cancellation.
a = v + d;
{% for line in map.sigma.matlab_mean_slope %}
{{ line }}
{% endfor %}
end

function q = over(a, d)
% a / d, and 1 for d = 0.
q = ones(size(d));
q(d ~= 0) = a(d ~= 0) ./ d(d ~= 0);
end
{% else %}
{% include "maps/" ~ written.template ~ ".m" %}
{% endif %}
{% else %}
p = zeros(0, 1);
A = f.A;
B = f.B;
C = f.C;
D = f.D;
end
{% endif %}
