{% if part == "start" %}
function s = {{ name }}_start()
% {{ NAME }}_START  Where an observer of {{ name }} starts: s.x = 0{% if G %}, and s.P is the covariance that the
%   states have in the data of the fit{% endif %}.
%
%   At each sample, with the measured output y and then the input u that is chosen:
%
%       s = {{ name }}_correct(s, u, y);
%       s = {{ name }}_advance(s, u);
%
%   s.x{% if G %} and s.P{% endif %} may be set before {{ name }}_correct.

m = {{ name }}_numbers();
s.x = zeros({{ nx }}, 1);
{% if K %}
s.e = zeros({{ ny }}, 1); % from correct to advance: y - y_hat
{% else %}
s.P = m.P0;
s.w = zeros({{ nx }}, 1); % from correct to advance: noise of the states, and its covariances
s.Pw = m.Q;
s.Pxw = zeros({{ nx }}, {{ nx }});
{% endif %}
end
{% elif part == "correct" %}
function s = {{ name }}_correct(s, u, y)
% {{ NAME }}_CORRECT  Make an observer of {{ name }} know the output y of this sample.
%
{% if K %}
%   With a constant gain s.x stays: y corrects the next state.
{% else %}
%   s.x is then the state that knows y, and s.P the covariance of its error.
{% endif %}
%   NaN in y is an output that is missing. {% if feedthrough %}y depends on u{% else %}No output depends on u{% endif %} at the same sample.

{% if K %}
[~, y_hat] = {{ name }}(s.x, u);
s.e = y(:) - y_hat;
s.e(isnan(s.e)) = 0;
{% else %}
m = {{ name }}_numbers();
[~, y_hat, ~, ~, H, ~] = {{ name }}(s.x, u);
e = y(:) - y_hat;
% A missing output has a row of zeros in H, and noise of its own alone.
known = diag(double(~isnan(e)));
e(isnan(e)) = 0;
H = known * H;
R = known * m.R * known + eye({{ ny }}) - known;
S = m.S * known;
both = [s.P * H.'; S] / (H * s.P * H.' + R);
L = both(1:{{ nx }}, :);
from_e = both({{ nx + 1 }}:{{ 2 * nx }}, :);
s.x = s.x + L * e;
s.w = from_e * e;
I_LH = eye({{ nx }}) - L * H;
s.P = I_LH * s.P * I_LH.' + L * R * L.';
s.Pw = m.Q - from_e * S.';
s.Pxw = -L * S.';
{% endif %}
end
{% else %}
function s = {{ name }}_advance(s, u)
% {{ NAME }}_ADVANCE  Go on to the next sample with the input u of this one.
%
%   A sample that was not corrected has no output.

{% if K %}
m = {{ name }}_numbers();
s.x = {{ name }}(s.x, u) + m.K * s.e;
s.e = zeros({{ ny }}, 1);
{% else %}
m = {{ name }}_numbers();
[x_next, ~, F, ~, ~, ~] = {{ name }}(s.x, u);
s.x = x_next + s.w;
across = F * s.Pxw;
P = F * s.P * F.' + s.Pw + across + across.';
s.P = (P + P.') / 2;
s.w = zeros({{ nx }}, 1);
s.Pw = m.Q;
s.Pxw = zeros({{ nx }}, {{ nx }});
{% endif %}
end
{% endif %}
