// A control loop around the filter, for boards whose double has 64 bits (ESP32, Teensy 4, SAMD, RP2040, STM32).
// Yours to write: the three functions declared first.
#include "ncs_filter.h"

// Puts one sample that has arrived into its arguments and returns true; false if there is none left. The oldest first.
bool next_sample(uint32_t *episode, uint32_t *stamp, double y[NCS_P]);
// Your controller, at the present estimate.
void propose(const double estimate[NCS_N], double u[NCS_M]);
// Drives the actuator, which holds the input until the next step.
void apply_input(const double u[NCS_M]);

static ncs_filter filter;
static const uint32_t EPISODE = 1;  // the sensor stamps with the same number, and with the number of the step
static uint32_t next_step_us;
static double held[NCS_M];  // what the actuator applies

void setup() {
  double first[NCS_N] = {0};  // where the plant stands, known within the plant's first_error
  pinMode(LED_BUILTIN, OUTPUT);
  while (!ncs_start(&filter, EPISODE, first)) {
    // The table of numbers was altered: nothing runs.
  }
  next_step_us = micros();
}

void loop() {
  uint32_t episode, stamp;
  double y[NCS_P], wanted[NCS_M];
  while ((int32_t)(micros() - next_step_us) < 0) {
  }
  while ((int32_t)(micros() - next_step_us) >= (int32_t)NCS_PERIOD_US) {  // a step was missed
    double u[NCS_M];
    ncs_decide(&filter, held, u);
    ncs_applied(&filter, held);
    next_step_us += NCS_PERIOD_US;
  }
  next_step_us += NCS_PERIOD_US;
  while (next_sample(&episode, &stamp, y)) {
    ncs_receive(&filter, episode, stamp, y);
  }
  propose(filter.estimate, wanted);
  ncs_decide(&filter, wanted, held);
  apply_input(held);
  digitalWrite(LED_BUILTIN, filter.reason == NCS_GUARANTEED ? LOW : HIGH);
}
