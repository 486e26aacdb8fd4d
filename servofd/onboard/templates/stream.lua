-- {{ file }}: sends what servos measure of themselves to the ground, as SRVP1, SRVP2, ... [deg].
-- Made by `servofd onboard --stream-only` {{ version }} for ArduPilot 4.6 or newer: copy it to APM/scripts, set SCR_ENABLE = 1.
local names = {}
for _, output in ipairs({ {{ outputs | join(", ") }} }) do
   names[output] = "SRVP" .. output
end

local function send()
   for output, name in pairs(names) do
      local telemetry = servo_telem:get_telem(output - 1)
      local position = telemetry and telemetry:measured_position()
      if position then
         gcs:send_named_float(name, position)
      end
   end
   return send, {{ period_ms }}
end

if servo_telem then
   return send()
end
gcs:send_text(2, "servofd: needs ArduPilot 4.6 with servo telemetry")
